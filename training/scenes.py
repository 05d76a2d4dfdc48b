"""Drawn scenes: rooms, streets, facades, blocks and poles in central projection, so that every straight edge of the
scene is exactly straight in the picture; and clutter, curved on purpose, that is not.

Coordinates in metres, x right, y up, z ahead; the camera stands at the origin, upright (its horizon may be shifted,
which keeps verticals parallel). Painter's algorithm, farthest surface first.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from training.textures import SIDE_PX, draw_texture

Float64 = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]

WIDTH_PX, HEIGHT_PX = 640, 480
NEAR_M = 0.2


@dataclass
class _Surface:
    """A textured parallelogram: corners (4, 3) in metres, in camera coordinates once placed."""

    corners: Float64
    texture: Float32
    background: bool = False


def draw_scene(rng: np.random.Generator) -> Bytes:
    """A grey picture, uint8 (HEIGHT_PX, WIDTH_PX)."""
    focal_px = float(rng.uniform(0.5, 1.6)) * WIDTH_PX
    horizon_px = HEIGHT_PX / 2 + float(rng.normal()) * HEIGHT_PX * 0.12
    layout: Callable[[np.random.Generator], tuple[list[_Surface], float]]
    layout = (_room, _room, _block_field, _facade_row, _street)[int(rng.integers(5))]
    surfaces, heading = layout(rng)
    turn = np.array([[math.cos(heading), 0, -math.sin(heading)], [0, 1, 0], [math.sin(heading), 0, math.cos(heading)]])
    canvas = _backdrop(horizon_px, rng)
    for surface in surfaces:
        surface.corners = surface.corners @ turn.T
    behind = [s for s in surfaces if s.background]
    before = sorted((s for s in surfaces if not s.background), key=_distance, reverse=True)
    for surface in behind + before:
        _paint(canvas, surface, focal_px, horizon_px, float(rng.uniform(0.6, 1.15)))
    _clutter(canvas, rng)
    if rng.random() < 0.5:
        canvas = np.asarray(cv2.GaussianBlur(canvas, (0, 0), float(rng.uniform(0.4, 1.2))), np.float32)
    canvas = canvas + rng.normal(0, rng.uniform(0.0, 0.02), canvas.shape).astype(np.float32)
    return np.asarray((canvas.clip(0, 1) ** np.float32(rng.uniform(0.7, 1.4)) * 255), np.uint8)


def _backdrop(horizon_px: float, rng: np.random.Generator) -> Float32:
    y = np.arange(HEIGHT_PX, dtype=np.float32)[:, None]
    zenith, haze, ground, near = rng.random(4)
    sky = zenith + (haze - zenith) * y / max(horizon_px, 1.0)
    floor = ground + (near - ground) * 0.5 * (y - horizon_px) / HEIGHT_PX
    clouds = cv2.resize(rng.random((6, 9)).astype(np.float32), (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_CUBIC)
    return np.asarray(np.where(y < horizon_px, sky, floor) + (clouds - 0.5) * rng.uniform(0, 0.4), np.float32)


def _distance(surface: _Surface) -> float:
    reach = np.linalg.norm(surface.corners, axis=1)
    return float(reach.max() if (surface.corners[:, 2] < 0.3).any() else reach.mean())


def _box(
    low: tuple[float, float, float], high: tuple[float, float, float], rng: np.random.Generator, *, inside: bool = False
) -> list[_Surface]:
    (x0, y0, z0), (x1, y1, z1) = low, high
    sides = [
        [(x0, y1, z0), (x1, y1, z0), (x1, y0, z0), (x0, y0, z0)],
        [(x1, y1, z1), (x0, y1, z1), (x0, y0, z1), (x1, y0, z1)],
        [(x0, y1, z1), (x0, y1, z0), (x0, y0, z0), (x0, y0, z1)],
        [(x1, y1, z0), (x1, y1, z1), (x1, y0, z1), (x1, y0, z0)],
        [(x0, y1, z0), (x1, y1, z0), (x1, y1, z1), (x0, y1, z1)],
        [(x0, y0, z1), (x1, y0, z1), (x1, y0, z0), (x0, y0, z0)],
    ]
    shared = draw_texture(rng) if not inside and rng.random() < 0.5 else None
    return [
        _Surface(np.array(side, float), draw_texture(rng) if shared is None else shared, background=inside)
        for side in sides
    ]


def _ground(eye_m: float, rng: np.random.Generator) -> _Surface:
    corners = [(-60, -eye_m, 60), (60, -eye_m, 60), (60, -eye_m, -60), (-60, -eye_m, -60)]
    return _Surface(np.array(corners, float), draw_texture(rng), background=True)


def _room(rng: np.random.Generator) -> tuple[list[_Surface], float]:
    eye, width, depth, height = (float(rng.uniform(*span)) for span in ((1, 2), (1.5, 5), (2, 7), (2.3, 4)))
    surfaces = _box((-width, -eye, -depth), (width, height - eye, depth), rng, inside=True)
    for _ in range(int(rng.integers(1, 9))):
        x, z = float(rng.uniform(-width, width)), float(rng.uniform(-depth, depth))
        half_x, half_z, tall = rng.uniform(0.15, 1.2, 3).tolist()
        floor = -eye if rng.random() < 0.7 else float(rng.uniform(-eye, height - eye - 0.5))
        surfaces += _box((x - half_x, floor, z - half_z), (x + half_x, floor + 1.6 * tall, z + half_z), rng)
    return surfaces, float(rng.uniform(-math.pi, math.pi))


def _block_field(rng: np.random.Generator) -> tuple[list[_Surface], float]:
    eye = float(rng.uniform(1, 2.5))
    surfaces = [_ground(eye, rng)] if rng.random() < 0.7 else []
    for _ in range(int(rng.integers(2, 12))):
        bearing, reach = float(rng.uniform(-math.pi, math.pi)), float(rng.uniform(5, 35))
        x, z = reach * math.sin(bearing), reach * math.cos(bearing)
        half_x, half_z = rng.uniform(1.5, 9, 2).tolist()
        if abs(x) > half_x + 1 or abs(z) > half_z + 1:
            surfaces += _box((x - half_x, -eye, z - half_z), (x + half_x, float(rng.uniform(2, 25)), z + half_z), rng)
    for _ in range(int(rng.integers(0, 10))):
        x, z = rng.uniform(-20, 20, 2).tolist()
        surfaces += _box((x - 0.1, -eye, z - 0.1), (x + 0.1, float(rng.uniform(2, 8)), z + 0.1), rng)
    return surfaces, float(rng.uniform(-math.pi, math.pi))


def _facade_row(rng: np.random.Generator) -> tuple[list[_Surface], float]:
    eye, front, x = float(rng.uniform(1, 2.5)), float(rng.uniform(3, 14)), -float(rng.uniform(3, 20))
    surfaces = [_ground(eye, rng)]
    while x < 25:
        wide, tall, set_back = (float(rng.uniform(*span)) for span in ((2, 12), (2.5, 20), (0, 1.5)))
        surfaces += _box((x, -eye, front + set_back), (x + wide, tall, front + 10), rng)
        x += wide + (float(rng.uniform(0, 3)) if rng.random() < 0.3 else 0.0)
    return surfaces + _street_furniture(eye, rng), _street_heading(rng)


def _street(rng: np.random.Generator) -> tuple[list[_Surface], float]:
    eye = float(rng.uniform(1, 2.5))
    surfaces = [_ground(eye, rng)]
    for side in (-1, 1):
        z, offset = 0.0, float(rng.uniform(2, 10))
        left = offset if side > 0 else -offset - 8
        while z < 60:
            long, tall = float(rng.uniform(4, 14)), float(rng.uniform(3, 22))
            surfaces += _box((left, -eye, z + 0.5), (left + 8, tall, z + long), rng)
            z += long + (float(rng.uniform(0, 4)) if rng.random() < 0.4 else 0.0)
    return surfaces + _street_furniture(eye, rng), _street_heading(rng)


def _street_heading(rng: np.random.Generator) -> float:
    return float(rng.uniform(-0.6, 0.6) if rng.random() < 0.5 else rng.normal() * 0.08)


def _street_furniture(eye: float, rng: np.random.Generator) -> list[_Surface]:
    surfaces = []
    for _ in range(int(rng.integers(0, 8))):
        x, z, half = float(rng.uniform(-6, 6)), float(rng.uniform(1.5, 12)), float(rng.uniform(0.04, 0.9))
        surfaces += _box((x - half, -eye, z - half), (x + half, float(rng.uniform(0.4, 5)) - eye, z + half), rng)
    return surfaces


def _paint(canvas: Float32, surface: _Surface, focal_px: float, horizon_px: float, light: float) -> None:
    corners = surface.corners
    visible: list[Float64] = []
    for here, there in zip(corners, np.roll(corners, -1, 0), strict=True):
        if here[2] > NEAR_M:
            visible.append(here)
        if (here[2] > NEAR_M) != (there[2] > NEAR_M):
            visible.append(here + (NEAR_M - here[2]) / (there[2] - here[2]) * (there - here))
    if len(visible) < 3:
        return
    outline = np.array(visible)
    x = focal_px * outline[:, 0] / outline[:, 2] + WIDTH_PX / 2
    y = horizon_px - focal_px * outline[:, 1] / outline[:, 2]
    left, right = int(max(0, x.min())), int(min(WIDTH_PX, x.max() + 2))
    top, bottom = int(max(0, y.min())), int(min(HEIGHT_PX, y.max() + 2))
    if right <= left or bottom <= top:
        return
    polygon = np.round(np.stack([x, y], 1).clip(-20000, 20000) * 16).astype(np.int32)
    mask = np.zeros((HEIGHT_PX, WIDTH_PX), np.uint8)
    cv2.fillConvexPoly(mask, polygon, 255, cv2.LINE_AA, 4)
    camera = np.array([[focal_px, 0, WIDTH_PX / 2 - left], [0, -focal_px, horizon_px - top], [0, 0, 1]])
    across, down = (corners[1] - corners[0]) / SIDE_PX, (corners[3] - corners[0]) / SIDE_PX
    view = camera @ np.stack([across, down, corners[0]], 1)
    if abs(np.linalg.det(view)) < 1e-12:
        return
    picture = cv2.warpPerspective(
        surface.texture, view, (right - left, bottom - top), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
    )
    cover = mask[top:bottom, left:right].astype(np.float32) / 255
    part = canvas[top:bottom, left:right]
    part[:] = part * (1 - cover) + cover * np.asarray(picture, np.float32) * np.float32(light)


def _clutter(canvas: Float32, rng: np.random.Generator) -> None:
    """Ellipses and wandering curves: people, plants, cables. They must teach the network what not to straighten."""
    for _ in range(int(rng.integers(0, 9))):
        centre = (int(rng.integers(0, WIDTH_PX)), int(rng.integers(0, HEIGHT_PX)))
        axes = (int(rng.integers(4, 90)), int(rng.integers(4, 90)))
        thickness = -1 if rng.random() < 0.6 else 2
        cv2.ellipse(
            canvas, centre, axes, float(rng.uniform(0, 360)), 0.0, 360.0, float(rng.random()), thickness, cv2.LINE_AA
        )
    for _ in range(int(rng.integers(0, 5))):
        walk = np.cumsum(rng.normal(0, 22, (25, 2)), 0) + rng.uniform(0, 1, 2) * (WIDTH_PX, HEIGHT_PX)
        curve = np.round(cv2.GaussianBlur(walk.astype(np.float32), (1, 7), 2)).astype(np.int32)
        cv2.polylines(canvas, [curve], False, float(rng.random()), int(rng.integers(1, 4)), cv2.LINE_AA)
