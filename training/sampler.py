"""Training samples: stored chains, seen through a random lens by an imperfect extractor.

No image is warped. A sample picks a picture of the store and a window of it, pushes the chain points of the window
through a random distortion (exactly, `distortions.bend`), and imitates what extraction would have done to them
(`imperfection`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from training.chain_store import DRAWN, LEVELS, QUANTUM, ChainStore
from training.distortions import DistortionBatch
from training.homographies import natural_tilts
from training.imperfection import FlatPoints, at_the_right_level, found, jitter
from training.labels import evaluation_points, evaluation_weights, fit_labels
from training.random_distortions import draw_distortions
from training.view_specs import ViewSpecs, view_specs
from training.windows import Windows, columns, draw_half_extents, draw_windows, target_view
from unbend_service.adapters.estimators.chain_features import ChainDescriptions, ChainPoints, describe

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]

UNSEARCHED_BORDER_PX = 5.0
LABELLED_SHARE = 4
"""Only the scales of the coefficients' errors are learned from labels, and fitting them is slow: one sample of four."""
_SEE_MARGIN = 0.07


@dataclass(frozen=True)
class TrainingBatch:
    """One batch.

    chains: the network's input, descriptions of points. source, target: float32 (B, n, 2), correspondences in the
    isotropic frame; weight: float32 (B, n). slopes: float32 (B, n, 2, 2), d source / d target. labels: float32
    (L, 72), fitted node values of the first L = B / LABELLED_SHARE samples.
    kind: int (B,) index into random_distortions.KINDS.
    """

    chains: ChainDescriptions
    points: ChainPoints
    source: Float32
    target: Float32
    weight: Float32
    slopes: Float32
    labels: Float32
    kind: Ints


class Sampler:
    """Draws batches from a store; all randomness comes from the generator passed in."""

    def __init__(
        self,
        store: ChainStore,
        drawn_share: float = 0.22,
        tilt_share: float = 0.1,
        square_share: float = 0.5,
        sources: tuple[str, ...] | None = None,
    ) -> None:
        """sources: of the photographs to draw from; None for all. Drawn scenes are always among the pictures."""
        self._store = store
        self._x = store.x.astype(np.float32) / np.float32(QUANTUM)
        self._y = store.y.astype(np.float32) / np.float32(QUANTUM)
        self._strength = store.strength.astype(np.float32)
        drawn = store.source == DRAWN
        wanted = ~drawn if sources is None else np.isin(store.source, sources)
        self._drawn, self._photographs = np.flatnonzero(drawn), np.flatnonzero(wanted)
        self._drawn_share = drawn_share if len(self._photographs) else 1.0
        self._tilt_share = tilt_share
        self._square_share = square_share

    def draw(self, size: int, rng: np.random.Generator, kinds: Ints | None = None) -> TrainingBatch:
        """A batch of `size` samples."""
        return self.draw_with_views(size, rng, kinds)[0]

    def draw_with_views(
        self, size: int, rng: np.random.Generator, kinds: Ints | None = None
    ) -> tuple[TrainingBatch, ViewSpecs]:
        """A batch of `size` samples, and what it takes to see the pictures that their chains are of."""
        distortions = draw_distortions(size, rng, kinds)
        half_extent = draw_half_extents(size, self._square_share, rng)
        points, windows, tilts = self._points(distortions, half_extent, rng)
        return with_truth(points, distortions, half_extent), view_specs(distortions, half_extent, windows, tilts)

    def _points(
        self, distortions: DistortionBatch, half_extent: Float64, rng: np.random.Generator
    ) -> tuple[ChainPoints, Windows, Float64]:
        low, high, stretch = target_view(distortions, half_extent)
        picture = self._pick(distortions.size, rng)
        windows = draw_windows(picture, self._store.size_px[picture], low, high, rng)
        points = self._gathered(windows, stretch)
        left, top = columns(low - _SEE_MARGIN)
        right, bottom = columns(high + _SEE_MARGIN)
        x, y, sample = points.x, points.y, points.sample
        points = points.kept((x > left[sample]) & (x < right[sample]) & (y > top[sample]) & (y < bottom[sample]))
        tilts = natural_tilts(distortions.size, self._tilt_share, rng)
        points = points.moved(*_tilted(tilts, points.x, points.y, points.sample))
        points, blur = at_the_right_level(points, distortions, windows.level)
        x, y, visible = distortions.bend(points.x, points.y, points.sample)
        points = points.moved(x, y)
        visible &= found(points, half_extent, rng)
        noise = jitter(windows.pixel, rng)[points.sample] * blur
        x = x + noise * rng.standard_normal(len(x), dtype=np.float32)
        y = y + noise * rng.standard_normal(len(x), dtype=np.float32)
        inner_x, inner_y = columns(half_extent - UNSEARCHED_BORDER_PX * windows.pixel[:, None])
        visible &= (np.abs(x) < inner_x[points.sample]) & (np.abs(y) < inner_y[points.sample])
        seen = points.moved(x, y).kept(visible).by_sample()
        chains = ChainPoints(
            x=seen.x,
            y=seen.y,
            strength=seen.strength,
            starts=seen.starts,
            picture=seen.sample,
            half_extent=half_extent.astype(np.float32),
            pixel=windows.pixel,
        )
        return chains, windows, tilts

    def _pick(self, size: int, rng: np.random.Generator) -> Ints:
        if not len(self._drawn):
            return self._photographs[rng.integers(len(self._photographs), size=size)]
        drawn = self._drawn[rng.integers(len(self._drawn), size=size)]
        if not len(self._photographs):
            return drawn
        photographs = self._photographs[rng.integers(len(self._photographs), size=size)]
        return np.where(rng.random(size) < self._drawn_share, drawn, photographs)

    def _gathered(self, windows: Windows, stretch: Float64) -> FlatPoints:
        """The stored chains of all levels that a sample may show, in its target frame; stretch: (B, 2), least and
        greatest magnification of the distortion."""
        levels = np.log(np.array(LEVELS))
        nearest = [
            np.abs(np.log(windows.level * bound)[:, None] - levels).argmin(1)
            for bound in (stretch[:, 1], stretch[:, 0])
        ]
        sample, level = np.nonzero(
            (np.arange(len(LEVELS)) >= nearest[0][:, None]) & (np.arange(len(LEVELS)) <= nearest[1][:, None])
        )
        entry = windows.picture[sample] * len(LEVELS) + level
        first, last = self._store.offsets[entry], self._store.offsets[entry + 1]
        slices = [slice(a, b) for a, b in zip(first.tolist(), last.tolist(), strict=True)]
        count = last - first
        owner = np.repeat(sample, count)
        x, y, strength, starts = (
            np.concatenate([a[s] for s in slices]) for a in (self._x, self._y, self._strength, self._store.starts)
        )
        return FlatPoints(
            x=x * windows.scale_x[owner] + windows.shift[0][owner],
            y=y * windows.scale_y[owner] + windows.shift[1][owner],
            strength=strength,
            starts=starts,
            sample=owner,
            level=np.repeat(level, count),
        )


def with_truth(points: ChainPoints, distortions: DistortionBatch, half_extent: Float64) -> TrainingBatch:
    """The batch of pictures of half_extent (B, 2) in which the distortions left these chain points."""
    source_x, source_y = evaluation_points(half_extent)
    target_x, target_y = distortions.straighten(source_x, source_y)
    slopes, area = _slopes(distortions, source_x, source_y, target_x, target_y)
    weight = evaluation_weights(target_x, target_y, area, half_extent)
    some = slice(0, max(1, distortions.size // LABELLED_SHARE))
    labels = fit_labels(source_x[some], source_y[some], target_x[some], target_y[some], weight[some])
    target = np.stack([target_x, target_y], -1).clip(-3, 3)
    return TrainingBatch(
        chains=describe(points),
        points=points,
        source=np.stack([source_x, source_y], -1).astype(np.float32),
        target=target.astype(np.float32),
        weight=weight.astype(np.float32),
        slopes=slopes.astype(np.float32),
        labels=labels.astype(np.float32),
        kind=distortions.kind,
    )


def _slopes(
    distortions: DistortionBatch, x: Float64, y: Float64, target_x: Float64, target_y: Float64
) -> tuple[Float64, Float64]:
    """d source / d target (B, n, 2, 2) and target area per source area (B, n), by differences."""
    step = 1e-3
    right, below = distortions.straighten(x + step, y), distortions.straighten(x, y + step)
    a, c = (right[0] - target_x) / step, (right[1] - target_y) / step
    b, d = (below[0] - target_x) / step, (below[1] - target_y) / step
    area = a * d - b * c
    safe = np.where(np.abs(area) < 0.02, 0.02, area)
    inverse = np.stack([np.stack([d, -b], -1), np.stack([-c, a], -1)], -2) / safe[..., None, None]
    return inverse.clip(-4, 4), np.abs(area)


def _tilted(tilts: Float64, x: Float32, y: Float32, sample: Ints) -> tuple[Float32, Float32]:
    """The points of samples whose tilt is not the identity, moved by it."""
    moving = np.flatnonzero(np.abs(tilts - np.eye(3)).max((1, 2)) > 0)
    index = np.flatnonzero(np.isin(np.arange(len(tilts)), moving)[sample])
    entries = np.ascontiguousarray(tilts.transpose(1, 2, 0), np.float32)
    owner, old_x, old_y = sample[index], x[index], y[index]
    depth, new_x, new_y = (
        entries[row, 0][owner] * old_x + entries[row, 1][owner] * old_y + entries[row, 2][owner] for row in (2, 0, 1)
    )
    depth = np.maximum(depth, np.float32(0.2))
    x, y = x.copy(), y.copy()
    x[index], y[index] = new_x / depth, new_y / depth
    return x, y
