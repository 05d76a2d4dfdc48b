"""Training samples with their pictures: photographs seen through a random lens, and the chains extracted from them.

Slower than `sampler` by far (a picture is warped and searched), and free of its imitations: this is how the picture
branch learns what to believe when there are few chains.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from training.distortions import DistortionBatch
from training.homographies import natural_tilts
from training.random_distortions import draw_distortions
from training.sampler import TrainingBatch, with_truth
from training.windows import Windows, draw_half_extents, draw_windows, target_view
from unbend_service.adapters.estimators.chain_features import ChainPoints
from unbend_service.adapters.estimators.chains import EdgeChains, extract
from unbend_service.adapters.estimators.views import view_of

Bytes = npt.NDArray[np.uint8]
Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]

_LATTICE_STEP_PX = 5
_MARGIN_STEPS = 2
"""The true map is computed on a lattice and interpolated by cubics, which is off by less than 0.01 px."""


@dataclass(frozen=True)
class PictureBatch:
    """A training batch, and views: uint8 (B, VIEW_PX, VIEW_PX), 255 times those of `views.view_of`."""

    batch: TrainingBatch
    views: Bytes


class PictureSampler:
    """Draws from grey pictures, uint8 of any size; all randomness comes from the generator passed in."""

    def __init__(self, pictures: list[Bytes], tilt_share: float = 0.1, square_share: float = 0.5) -> None:
        self._pictures = pictures
        self._extents_px = np.array([(p.shape[1], p.shape[0]) for p in pictures], np.float64)
        self._tilt_share = tilt_share
        self._square_share = square_share

    def draw(self, size: int, rng: np.random.Generator) -> PictureBatch:
        """A batch of `size` samples."""
        distortions = draw_distortions(size, rng)
        half_extent = draw_half_extents(size, self._square_share, rng)
        low, high, _ = target_view(distortions, half_extent)
        picture = rng.integers(len(self._pictures), size=size)
        windows = draw_windows(picture, self._extents_px[picture], low, high, rng)
        tilts = natural_tilts(size, self._tilt_share, rng)
        seen = [
            self._seen(one, distortions.only(one), half_extent[one], windows, tilts[one], rng) for one in range(size)
        ]
        views = np.stack([np.round(view_of(grey) * 255).astype(np.uint8) for grey in seen])
        points = joined([extract(grey) for grey in seen])
        return PictureBatch(with_truth(points, distortions, half_extent), views)

    def _seen(
        self,
        one: int,
        distortion: DistortionBatch,
        half_extent: Float64,
        windows: Windows,
        tilt: Float64,
        rng: np.random.Generator,
    ) -> Bytes:
        """What a camera with this lens shows of its window."""
        half_px = 1 / float(windows.pixel[one])
        width, height = (max(16, round(2 * half * half_px)) for half in half_extent)
        target = _target_of_pixels(distortion, width, height, max(width, height) / 2)
        x, y = _projected(np.asarray(np.linalg.inv(tilt), np.float64), *target)
        picture = self._pictures[int(windows.picture[one])]
        x = (x - windows.shift[0][one]) / windows.scale_x[one]
        y = (y - windows.shift[1][one]) / windows.scale_y[one]
        # Reduced first where the camera shows less than the photograph holds, or it would alias.
        shrink = min(1.0, float(windows.level[one]))
        if shrink < 0.95:
            size = (max(8, round(picture.shape[1] * shrink)), max(8, round(picture.shape[0] * shrink)))
            picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
        rows, columns = picture.shape
        # Isotropic coordinates know the proportions of the photograph, and those of the reduced one are rounded.
        half_long_px = max(rows, columns) / 2
        map_x = x * half_long_px + (columns / 2 - 0.5)
        map_y = y * half_long_px + (rows / 2 - 0.5)
        seen = cv2.remap(
            picture, map_x.astype(np.float32), map_y.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
        )
        return _developed(np.asarray(seen, np.uint8), rng)


def joined(chains: list[EdgeChains]) -> ChainPoints:
    """The chains of several pictures as one batch."""
    return ChainPoints(
        x=np.concatenate([c.x for c in chains]),
        y=np.concatenate([c.y for c in chains]),
        strength=np.concatenate([c.strength for c in chains]),
        starts=np.concatenate([c.starts for c in chains]),
        picture=np.repeat(np.arange(len(chains)), [len(c.x) for c in chains]),
        half_extent=np.array([(c.half_width, c.half_height) for c in chains], np.float32),
        pixel=np.array([c.pixel for c in chains], np.float32),
    )


def _target_of_pixels(
    distortion: DistortionBatch, width: int, height: int, half_long_px: float
) -> tuple[Float32, Float32]:
    """Isotropic target coordinates (height, width) of the pixel centres of the distorted picture."""
    columns, rows = (side // _LATTICE_STEP_PX + 2 * _MARGIN_STEPS for side in (width, height))
    step = float(_LATTICE_STEP_PX)
    at_x = (np.arange(columns) - _MARGIN_STEPS + 0.5) * step
    at_y = (np.arange(rows) - _MARGIN_STEPS + 0.5) * step
    grid_x, grid_y = np.meshgrid((at_x - width / 2) / half_long_px, (at_y - height / 2) / half_long_px)
    x, y = distortion.straighten(grid_x.reshape(1, -1), grid_y.reshape(1, -1))
    index_x = ((np.arange(width) + 0.5) / step - 0.5 + _MARGIN_STEPS).astype(np.float32)
    index_y = ((np.arange(height) + 0.5) / step - 0.5 + _MARGIN_STEPS).astype(np.float32)
    over_x, over_y = np.meshgrid(index_x, index_y)
    coarse = np.stack([x.reshape(rows, columns), y.reshape(rows, columns)], -1).clip(-4, 4).astype(np.float32)
    fine = cv2.remap(coarse, over_x, over_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(fine[..., 0], np.float32), np.asarray(fine[..., 1], np.float32)


def _projected(matrix: Float64, x: Float32, y: Float32) -> tuple[Float32, Float32]:
    if np.abs(matrix - np.eye(3)).max() < 1e-9:
        return x, y
    entries = (matrix / matrix[2, 2]).astype(np.float32)
    depth = np.maximum(entries[2, 0] * x + entries[2, 1] * y + 1, np.float32(0.2))
    moved_x = (entries[0, 0] * x + entries[0, 1] * y + entries[0, 2]) / depth
    return moved_x, (entries[1, 0] * x + entries[1, 1] * y + entries[1, 2]) / depth


def _developed(grey: Bytes, rng: np.random.Generator) -> Bytes:
    """Tone, softness and noise of another camera."""
    tone = np.arange(256) / 255
    tone = (tone ** rng.uniform(0.7, 1.4) * rng.uniform(0.75, 1.0) + rng.uniform(0.0, 0.1)).clip(0, 1)
    grey = np.asarray(cv2.LUT(grey, np.round(tone * 255).astype(np.uint8)), np.uint8)
    if rng.random() < 0.2:
        grey = np.asarray(cv2.GaussianBlur(grey, (0, 0), float(rng.uniform(0.4, 1.0))), np.uint8)
    if rng.random() < 0.4:
        noise = rng.standard_normal(grey.shape, dtype=np.float32) * np.float32(rng.uniform(0, 6))
        grey = np.clip(grey + noise, 0, 255).astype(np.uint8)
    return grey
