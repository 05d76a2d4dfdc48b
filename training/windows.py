"""Where in a picture a training sample looks: random windows, formats and scales. Isotropic frame."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from training.distortions import DistortionBatch

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

SEARCHED_LONG_SIDE_PX = (256.0, 384.0)
"""Long side, in pixels, of the distorted picture that is searched for chains."""
COARSEST_ZOOM = 0.6
"""Photograph pixels per pixel of a 256 frame: windows may be enlarged this much, as small crops are."""
_BBOX_REACH = 1.9


@dataclass(frozen=True)
class Windows:
    """Where in which picture each sample looks.

    picture: (B,) of the store. level: (B,), the scale of that picture at which its pixels are those of the sample.
    Isotropic picture coordinates times scale (B,) plus shift (B,) are isotropic target coordinates.
    pixel: (B,), isotropic size of a searched pixel.
    """

    picture: Ints
    level: Float32
    scale_x: Float32
    scale_y: Float32
    shift: tuple[Float32, Float32]
    pixel: Float32


def draw_half_extents(size: int, square_share: float, rng: np.random.Generator) -> Float64:
    """Half extents (B, 2) of pictures, isotropic: squares, and the usual formats of cameras."""
    common = rng.choice([4 / 3, 3 / 2, 16 / 9], size)
    aspect = np.where(rng.random(size) < 0.7, common, np.exp(rng.uniform(0, math.log(2.2), size)))
    aspect = np.where(rng.random(size) < square_share, 1.0, aspect)
    short = 1 / aspect
    portrait = rng.random(size) < 0.25
    return np.stack([np.where(portrait, short, 1.0), np.where(portrait, 1.0, short)], 1)


def draw_windows(picture: Ints, extent_px: Float64, low: Float64, high: Float64, rng: np.random.Generator) -> Windows:
    """Random windows of pictures (B,), of extent_px (B, 2), that show the target rectangle low..high (B, 2)."""
    size = len(low)
    span = high - low
    # Picture pixels per isotropic unit of the target frame, at which the needed rectangle just fits the picture.
    fitting = ((extent_px - 2) / span).min(1)
    floor = np.minimum(fitting, COARSEST_ZOOM * 128)
    zoom = fitting * (floor / fitting) ** rng.random(size)
    smallest, largest = SEARCHED_LONG_SIDE_PX
    varied = smallest * (largest / smallest) ** rng.random(size)
    searched = np.where(rng.random(size) < 0.5, smallest, varied)
    corner_px = 1 - extent_px / 2 + rng.random((size, 2)) * (extent_px - 2 - zoom[:, None] * span)
    scale = extent_px.max(1) / 2 / zoom
    mirrored = np.where(rng.random(size) < 0.5, -1, 1)
    return Windows(
        picture=picture,
        level=np.asarray(searched / 2 / zoom * np.exp(0.12 * rng.normal(size=size)), np.float32),
        scale_x=(scale * mirrored).astype(np.float32),
        scale_y=scale.astype(np.float32),
        shift=columns(low - corner_px / zoom[:, None]),
        pixel=(2 / searched).astype(np.float32),
    )


def target_view(distortions: DistortionBatch, half_extent: Float64) -> tuple[Float64, Float64, Float64]:
    """What each picture shows of its target frame: low and high corner (B, 2) of its bounding box, within
    +-_BBOX_REACH; and the least and greatest magnification, source per target, (B, 2)."""
    side = 11
    steps = np.linspace(-1, 1, side)
    grid_x, grid_y = (a.ravel() for a in np.meshgrid(steps, steps))
    x, y = distortions.straighten(half_extent[:, :1] * grid_x, half_extent[:, 1:] * grid_y)
    lattice = np.stack([x, y], -1).reshape(-1, side, side, 2)
    along, down = lattice[:, :-1, 1:] - lattice[:, :-1, :-1], lattice[:, 1:, :-1] - lattice[:, :-1, :-1]
    area = np.abs(along[..., 0] * down[..., 1] - along[..., 1] * down[..., 0]).reshape(len(x), -1)
    cell = half_extent.prod(1)[:, None] * (2 / (side - 1)) ** 2
    magnification = np.sqrt(cell / np.maximum(area, 1e-6)).clip(0.2, 5)
    x, y = x.clip(-_BBOX_REACH, _BBOX_REACH), y.clip(-_BBOX_REACH, _BBOX_REACH)
    low, high = np.stack([x.min(1), y.min(1)], 1) - 1 / 128, np.stack([x.max(1), y.max(1)], 1) + 1 / 128
    return low, high, np.stack([magnification.min(1), magnification.max(1)], 1)


def columns(pairs: Float64) -> tuple[Float32, Float32]:
    """Both columns of (B, 2), contiguous, which makes looking them up for every point three times as fast."""
    return np.ascontiguousarray(pairs[:, 0], np.float32), np.ascontiguousarray(pairs[:, 1], np.float32)
