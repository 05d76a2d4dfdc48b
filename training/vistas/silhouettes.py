"""What has no straight edge: leaves, people, animals, cars, crockery, as flat pieces that stand in a drawn scene. They
teach the network what not to straighten."""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from training.vistas.materials import SIDE_PX, Material, noise, plain, span
from training.vistas.raster import Raster
from training.vistas.sites import Site

Float32 = npt.NDArray[np.float32]
Points = npt.NDArray[np.float64]


def foliage(rng: np.random.Generator) -> Material:
    """A clump of leaves with holes; once over a panel."""
    y, x = np.mgrid[-1 : 1 : SIDE_PX * 1j, -1 : 1 : SIDE_PX * 1j]
    radius = np.hypot(x, y) + (noise(7, rng) - 0.5) * 0.9 + (noise(30, rng) - 0.5) * 0.5
    holes = noise(44, rng) + (noise(12, rng) - 0.5) * 0.8
    cover = (radius < 0.85) & (holes > rng.uniform(0.1, 0.45))
    leaves = noise(64, rng) * 0.6 + noise(110, rng) * 0.5 + (y < -0.2) * 0.08
    tone = rng.uniform(0.05, 0.45) + leaves * rng.uniform(0.15, 0.6)
    return Material(np.asarray(tone, np.float32), 1.0, cover.astype(np.float32))


def person(rng: np.random.Generator) -> Material:
    """Somebody who stands or walks, about two and a half heads wide; once over a panel of 0.45 : 1."""
    rows, columns = SIDE_PX, 116
    tone, cover = np.zeros((rows, columns), np.float32), np.zeros((rows, columns), np.uint8)
    middle, lean = columns / 2, float(rng.normal() * 4)
    skin, shirt, trousers, hair = (float(v) for v in rng.uniform(0.05, 0.95, 4))

    def limb(start: tuple[float, float], end: tuple[float, float], width: float, shade: float) -> None:
        bow = np.array([(start[0] + end[0]) / 2 + rng.normal() * 4, (start[1] + end[1]) / 2])
        path = np.array([start, bow, end])
        steps = np.linspace(0, 1, 9)[:, None]
        curve = (1 - steps) ** 2 * path[0] + 2 * steps * (1 - steps) * path[1] + steps**2 * path[2]
        for canvas, value in ((tone, shade), (cover, 255)):
            cv2.polylines(canvas, [np.round(curve).astype(np.int32)], False, value, int(width))

    hip, shoulder = 132.0, 58.0
    for side in (-1, 1):
        limb((middle + side * 9, hip), (middle + side * rng.uniform(4, 24), 248), rng.uniform(14, 20), trousers)
        limb(
            (middle + side * 20 + lean, shoulder),
            (middle + side * rng.uniform(16, 42), rng.uniform(90, 150)),
            11,
            shirt,
        )
    torso = np.array([[-22, 50], [22, 50], [rng.uniform(16, 24), hip + 10], [-rng.uniform(16, 24), hip + 10]])
    outline = _smooth(torso + np.array([middle + lean, 0.0]))
    for canvas, value in ((tone, shirt), (cover, 255)):
        cv2.fillPoly(canvas, [outline], value)
    head = (round(middle + lean * 1.5), 26)
    for canvas, value in ((tone, skin), (cover, 255)):
        cv2.ellipse(canvas, head, (14, 19), 0.0, 0.0, 360.0, value, -1)
    cv2.ellipse(tone, (head[0], head[1] - 8), (15, 13), 0.0, 180.0, 360.0, hair, -1)
    cv2.rectangle(cover, (head[0] - 6, 40), (head[0] + 6, 54), 255, -1)
    folds = (noise(20, rng)[:, :columns] - 0.5) * 0.25
    return Material(tone + folds, 1.0, (cover > 0).astype(np.float32))


def people(
    raster: Raster, x: tuple[float, float], z: tuple[float, float], count: int, rng: np.random.Generator
) -> None:
    """Some who stand about, within `x` and `z` of the world, turned to the camera."""
    for _ in range(count):
        tall = span(rng, 1.0, 1.9)
        place = Site.facing(raster, (span(rng, *x), 0.0, span(rng, *z)), math.pi + raster.camera.heading)
        place.panel((-0.227 * tall, 0.227 * tall), (0, tall), 0.0, person(rng))


def car(rng: np.random.Generator) -> Material:
    """A car seen from the side; once over a panel of 2.6 : 1."""
    rows, columns = 100, SIDE_PX
    body, glass = float(rng.uniform(0.05, 0.95)), float(rng.uniform(0.05, 0.5))
    tone, cover = np.full((rows, columns), body, np.float32), np.zeros((rows, columns), np.uint8)
    roof, front, back = rng.uniform(4, 14), rng.uniform(60, 100), rng.uniform(170, 230)
    shape = [[4, 78], [2, 52], [front - 34, 44], [front, roof], [back - 30, roof], [back, 42], [250, 50], [252, 78]]
    cv2.fillPoly(cover, [_smooth(np.array(shape, float), 5)], 255)
    pane = [[front - 22, 42], [front + 3, roof + 6], [back - 33, roof + 6], [back - 14, 42]]
    cv2.fillPoly(tone, [_smooth(np.array(pane, float), 3)], glass)
    cv2.line(tone, (round((front + back) / 2 - 12), 8), (round((front + back) / 2 - 12), 74), body * 0.7, 4)
    tone[62:66] *= 0.85
    for wheel in (52, 204):
        for canvas, value in ((tone, 0.05), (cover, 255)):
            cv2.circle(canvas, (wheel, 78), 19, value, -1)
        cv2.circle(tone, (wheel, 78), 10, float(rng.uniform(0.3, 0.8)), -1)
    sheen = np.linspace(0.12, -0.12, rows, dtype=np.float32)[:, None]
    material = Material(tone + sheen, 1.0, (cover > 0).astype(np.float32))
    return material if rng.random() < 0.5 else Material(tone[:, ::-1] + sheen, 1.0, material.cover[:, ::-1])  # type: ignore[index]  # it has one


def tree(site: Site, height: float, rng: np.random.Generator) -> None:
    """A trunk, some boughs, and clumps of leaves around; or bare boughs."""
    bark = Material(noise(40, rng, 1) * 0.25 + float(rng.uniform(0.05, 0.4)), 0.6)
    fork, radius = height * float(rng.uniform(0.25, 0.5)), height * float(rng.uniform(0.012, 0.03))
    site.round(0, 0, [(radius * 1.4, 0), (radius, fork), (radius * 0.6, height * 0.8)], bark, sides=8)
    for _ in range(int(rng.integers(3, 9))):
        lean, reach = float(rng.uniform(-1, 1)), height * float(rng.uniform(0.15, 0.4))
        start, end = fork + (height * 0.75 - fork) * float(rng.random()), float(rng.uniform(0.4, 1.0)) * reach
        site.face(
            [
                (0, start, 0),
                (lean * reach, start + end, 0.1),
                (lean * reach * 0.98, start + end - 0.02, 0.1),
                (0, start - 2 * radius, 0),
            ],
            bark,
        )
    if rng.random() < 0.85:
        crowns = [foliage(rng) for _ in range(2)]
        for _ in range(int(rng.integers(4, 11))):
            size = height * float(rng.uniform(0.15, 0.3))
            s, out = (float(v) for v in rng.normal(0, height * 0.14, 2))
            t = float(rng.uniform(fork + 0.5 * size, height))
            site.panel(
                (s - size, s + size),
                (t - size, t + size),
                out,
                crowns[int(rng.integers(2))],
                float(rng.uniform(0.6, 1.2)),
            )


def bush(site: Site, size: float, rng: np.random.Generator) -> None:
    """Leaves down to the ground."""
    leaves = foliage(rng)
    for _ in range(int(rng.integers(2, 5))):
        s, out, half = (
            float(v) for v in (rng.normal(0, size * 0.4), rng.normal(0, size * 0.3), size * rng.uniform(0.4, 0.8))
        )
        site.panel(
            (s - half, s + half), (-0.1, half * float(rng.uniform(1.2, 2))), out, leaves, float(rng.uniform(0.7, 1.2))
        )


def potted_plant(site: Site, height: float, rng: np.random.Generator) -> None:
    """A pot and what grows in it."""
    pot = height * float(rng.uniform(0.2, 0.4))
    profile = [(pot * 0.32, 0.0), (pot * float(rng.uniform(0.35, 0.6)), pot)]
    site.round(0, 0, profile, plain(float(rng.uniform(0.1, 0.9))), sides=16)
    leaves = foliage(rng)
    for turn in (0.0, 1.2, 2.3):
        around = site.moved(0, pot * 0.7, 0, turn)
        half = height * float(rng.uniform(0.25, 0.45))
        around.face(
            [(-half, height - pot, 0), (half, height - pot, 0), (half, 0, 0), (-half, 0, 0)], leaves, stretched=True
        )


def crockery(site: Site, size: float, rng: np.random.Generator) -> None:
    """A bowl, bottle, vase, lampshade, can or cup."""
    shade = plain(float(rng.uniform(0.05, 1.0)))
    kind = int(rng.integers(4))
    radius = size * float(rng.uniform(0.2, 0.5))
    if kind == 0:
        profile = [(radius, 0.0), (radius, size)]
    elif kind == 1:
        profile = [(radius * 0.8, 0.0), (radius * 0.8, size * 0.55), (radius * 0.3, size * 0.75), (radius * 0.3, size)]
    elif kind == 2:
        heights = np.linspace(0, 1, 6).tolist()
        profile = [(radius * (0.5 + 0.5 * math.sin(2.6 * h + 0.3)), size * h) for h in heights]
    else:
        profile = [(radius * 0.4, 0.0), (radius * 1.3, size * 0.5), (radius * 1.5, size * 0.6)]
    site.round(0, 0, profile, shade, sides=20)


def _smooth(outline: Points, rounds: int = 2) -> npt.NDArray[np.int32]:
    """A closed outline with its corners cut, again and again."""
    for _ in range(min(rounds, 3)):
        ahead = np.roll(outline, -1, 0)
        outline = np.stack([0.82 * outline + 0.18 * ahead, 0.18 * outline + 0.82 * ahead], 1).reshape(-1, 2)
    return np.round(outline).astype(np.int32)
