"""A picture with a depth at every pixel: polygons in metres, drawn in any order, nearest in front.

Camera coordinates: x right, y up, z ahead, metres; the camera is upright (its horizon may be shifted, which keeps
verticals parallel), so every straight edge of a scene is exactly straight in the picture. Drawn at twice the size and
shrunk by the caller, whence smooth edges.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from training.vistas.materials import Material

Float64 = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]

NEAR_M = 0.15
_SUBPIXEL_BITS = 4
_FARTHEST_PX = 20000.0
_SMALLEST_TEXTURED_PX = 5


@dataclass(frozen=True)
class Camera:
    """Where the camera stands and looks: eye (3,) metres in the world, heading in radians to the right of +z, focal
    length and horizon in pixels of the raster."""

    eye: Float64
    heading: float
    focal_px: float
    horizon_px: float

    def seen(self, points: Float64) -> Float64:
        """(n, 3) world -> camera coordinates."""
        return self.turned(points - self.eye)

    def turned(self, directions: Float64) -> Float64:
        """(..., 3) directions of the world as the camera sees them."""
        c, s = math.cos(self.heading), math.sin(self.heading)
        return np.asarray(directions @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]))


class Raster:
    """Tones and inverse depths, float32 (height, width) each; 0 depth is infinitely far."""

    def __init__(self, width: int, height: int, camera: Camera, light: Float64, ambient: float) -> None:
        self.camera = camera
        self.tone: Float32 = np.zeros((height, width), np.float32)
        self.nearness: Float32 = np.zeros((height, width), np.float32)
        self._light, self._ambient = camera.turned(light / np.linalg.norm(light)), ambient
        self._centre = np.array([width / 2, camera.horizon_px]) - 0.5  # as rows and columns are counted

    def polygon(
        self,
        seen: Float64,
        material: Material,
        tone: float = 1.0,
        *,
        stretched: bool = False,
        one_sided: bool = False,
    ) -> None:
        """A flat convex polygon, (n, 3) in camera coordinates, clockwise as seen from its front.

        Args:
            material: repeats in metres from the first corner along the first side; with `stretched` it covers the
                parallelogram of corners 0, 1 and the last, once. Where it has a cover, only that is drawn.
            one_sided: is not seen from behind.
        """
        normal = _normal(seen)
        facing = float(normal @ seen[0])
        if abs(facing) < 1e-9 or (one_sided and facing > 0):
            return
        outline = _clipped(seen)
        if len(outline) < 3:
            return
        focal = self.camera.focal_px
        points = outline[:, :2] / outline[:, 2:] * (focal, -focal) + self._centre
        height, width = self.tone.shape
        (x0, y0), (x1, y1) = points.min(0).tolist(), points.max(0).tolist()
        left, top = max(math.floor(x0), 0), max(math.floor(y0), 0)
        right, bottom = min(math.ceil(x1) + 1, width), min(math.ceil(y1) + 1, height)
        if right <= left or bottom <= top:
            return
        grid = np.round((points - (left, top)).clip(-_FARTHEST_PX, _FARTHEST_PX) * (1 << _SUBPIXEL_BITS))
        inside = np.zeros((bottom - top, right - left), np.uint8)
        cv2.fillConvexPoly(inside, grid.astype(np.int32), 1, cv2.LINE_8, _SUBPIXEL_BITS)
        # 1 / z of the plane normal . p = facing, at the ray through a pixel: affine in the picture
        u = (np.arange(left, right) - self._centre[0]) * (normal[0] / focal / facing)
        v = (self._centre[1] - np.arange(top, bottom)) * (normal[1] / focal / facing) + normal[2] / facing
        nearness = v.astype(np.float32)[:, None] + u.astype(np.float32)
        part = slice(top, bottom), slice(left, right)
        visible = (inside > 0) & (nearness > self.nearness[part])
        if not visible.any():
            return
        shade = tone * self._shade(normal if facing < 0 else -normal)
        small = min(right - left, bottom - top) < _SMALLEST_TEXTURED_PX
        if material.flat or (small and material.cover is None):
            np.copyto(self.tone[part], np.float32(shade * material.mean), where=visible)
        else:
            scale = np.linalg.norm(seen[1] - seen[0]) if stretched else material.size_m
            depth = math.sqrt(float(outline[:, 2].min() * outline[:, 2].max()))
            level = material.level(focal * float(scale) / depth)
            drawn = self._warped(level[0], seen, material, stretched, (left, top, right, bottom))
            if level[1] is not None:
                visible &= self._warped(level[1], seen, material, stretched, (left, top, right, bottom)) > 0.5
            np.copyto(self.tone[part], drawn * np.float32(shade), where=visible)
        np.copyto(self.nearness[part], nearness, where=visible)

    def misses(self, seen: Float64) -> bool:
        """Whether all of (n, 3) camera coordinates are behind the camera, or beyond one side of the picture."""
        z = seen[:, 2]
        if z.max() <= NEAR_M:
            return True
        if z.min() <= NEAR_M:
            return False
        focal, (height, width) = self.camera.focal_px, self.tone.shape
        x, y = seen[:, 0] / z * focal + self._centre[0], self._centre[1] - seen[:, 1] / z * focal
        return bool(x.max() < 0 or x.min() > width or y.max() < 0 or y.min() > height)

    def _shade(self, normal: Float64) -> float:
        unit = normal / math.sqrt(float(normal @ normal))
        return self._ambient + (1 - self._ambient) * max(0.0, float(unit @ self._light))

    def _warped(
        self, texture: Float32, seen: Float64, material: Material, stretched: bool, box: tuple[int, int, int, int]
    ) -> Float32:
        left, top, right, bottom = box
        rows, columns = texture.shape
        along, across = seen[1] - seen[0], seen[-1] - seen[0]
        if stretched:
            along, across = along / columns, across / rows
        else:
            across = across - along * (across @ along) / (along @ along)  # square, whatever the polygon's corners
            along = along / np.linalg.norm(along) * material.size_m / columns
            across = across / np.linalg.norm(across) * material.size_m / rows
        focal = self.camera.focal_px
        pixels = np.array([[focal, 0, self._centre[0] - left], [0, -focal, self._centre[1] - top], [0, 0, 1]])
        view = pixels @ np.stack([along, across, seen[0]], 1)
        border = cv2.BORDER_REPLICATE if stretched else cv2.BORDER_WRAP
        return np.asarray(
            cv2.warpPerspective(texture, view, (right - left, bottom - top), flags=cv2.INTER_LINEAR, borderMode=border)
        )


def _normal(seen: Float64) -> Float64:
    """The cross product of a polygon's sides at its first corner; np.cross takes four times as long."""
    (ax, ay, az), (bx, by, bz) = (seen[1] - seen[0]).tolist(), (seen[-1] - seen[0]).tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def _clipped(corners: Float64) -> Float64:
    """What of a polygon lies before the camera."""
    if (corners[:, 2] > NEAR_M).all():
        return corners
    kept: list[Float64] = []
    for here, there in zip(corners, [*corners[1:], corners[0]], strict=True):
        if here[2] > NEAR_M:
            kept.append(here)
        if (here[2] > NEAR_M) != (there[2] > NEAR_M):
            kept.append(here + (NEAR_M - here[2]) / (there[2] - here[2]) * (there - here))
    return np.array(kept).reshape(-1, 3)
