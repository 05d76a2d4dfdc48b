"""What the suites work on: one lens, frames that differ, and pictures that compress like photographs."""

from __future__ import annotations

import cv2
import numpy as np

from unbend_service.adapters.renderers.sampling import Float32, PlaneSampling
from unbend_service.application.ports import Bytes
from unbend_service.domain.frames import Frame, PixelFormat, frame_size_bytes, planes, split_planes
from unbend_service.domain.grid import Grid
from unbend_service.domain.maps import BackwardMap, Float64

GRID_POINTS = 65


def barrel(strength: float = 0.15) -> BackwardMap:
    """Division model with lambda = -``strength``, scaled so that every target point has a source point."""

    def source(target: Float64) -> Float64:
        radius = np.hypot(target[..., 0], target[..., 1])[..., None]
        return np.asarray(target / (1 + strength * radius**2))

    return source


def barrel_grid(strength: float = 0.15) -> Grid:
    """The grid of :func:`barrel`, 65 x 65 points."""
    return Grid.from_map(barrel(strength), GRID_POINTS)


def frames(pixel_format: PixelFormat, width: int, height: int, count: int) -> list[Frame]:
    """Frames of noise, unlike each other: more of them than the caches hold, as in a stream."""
    random = np.random.default_rng(1)
    size = frame_size_bytes(pixel_format, width, height)
    return [Frame(pixel_format, width, height, random.integers(0, 256, size, np.uint8)) for _ in range(count)]


def photograph(width: int, height: int, seed: int = 1) -> Bytes:
    """(height, width, 3) uint8 RGB: soft colours, edges and grain; as a JPEG of quality 92 about 2.5 bits a pixel."""
    random = np.random.default_rng(seed)
    coarse = random.integers(0, 256, (9, 16, 3), np.uint8)
    picture = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    for _ in range(60):
        ends = random.integers(0, (width, height), (2, 2)).tolist()
        colour = random.integers(0, 256, 3).tolist()
        cv2.line(picture, ends[0], ends[1], colour, max(1, width // 400), cv2.LINE_AA)
    grain = random.normal(0, 4, (height, width, 1)).astype(np.int16)
    return np.asarray(np.clip(picture + grain, 0, 255), dtype=np.uint8)


def bent(picture: Bytes, strength: float = 0.2) -> Bytes:
    """(height, width, 3) uint8: the middle of a picture through a barrel lens, division model, half the width is 1."""
    height, width = picture.shape[:2]
    x, y = ((2 * np.arange(n, dtype=np.float32) + 1 - n) / width for n in (width, height))
    zoom = (1 - 0.6 * strength) / (1 - strength * (x[None] ** 2 + y[:, None] ** 2))
    map_x, map_y = (width * x[None] * zoom + width - 1) / 2, (width * y[:, None] * zoom + height - 1) / 2
    return np.asarray(cv2.remap(picture, map_x, map_y, cv2.INTER_LINEAR), dtype=np.uint8)


def jpeg(picture: Bytes, quality: int = 92) -> bytes:
    """A JPEG file of (height, width, 3) uint8 RGB, 4:2:0."""
    _, body = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return body.tobytes()


class BareRemap:
    """The peer of the renderers: cv2.remap called by hand, plane by plane, with float32 maps made beforehand.

    A new array is made for each picture, as a caller of cv2.remap gets it and as the pool returns it.
    """

    def __init__(self, frame: Frame, grid: Grid) -> None:
        self.maps: list[tuple[Float32, Float32]] = []
        for plane in planes(frame.pixel_format, frame.width, frame.height):
            self.maps.append(PlaneSampling.of(frame, plane).source_maps(grid, 0, plane.height))

    def __call__(self, frame: Frame) -> Bytes:
        drawn = np.empty(frame.data.size, np.uint8)
        targets = split_planes(drawn, frame.pixel_format, frame.width, frame.height)
        for source, target, (x, y) in zip(frame.plane_arrays(), targets, self.maps, strict=True):
            cv2.remap(source, x, y, cv2.INTER_LINEAR, dst=target, borderMode=cv2.BORDER_REPLICATE)
        return drawn
