"""Training samples: stored chains, seen through a random lens by an imperfect extractor.

No image is warped. A sample picks a picture of the store and a window of it, pushes the chain points of the window
through a random distortion (exactly, `distortions.bend`), and imitates what extraction would have done to them: chains
missed altogether or for want of contrast, a blank region, breaks, jitter, and the border it does not search.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from training.chain_store import DRAWN, LEVELS, QUANTUM, ChainStore
from training.distortions import DistortionBatch
from training.homographies import natural_tilts
from training.labels import evaluation_points, evaluation_weights, fit_labels
from training.random_distortions import draw_distortions
from unbend_service.adapters.estimators.chain_features import ChainDescriptions, ChainPoints, describe

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]

SEARCHED_LONG_SIDE_PX = (256.0, 384.0)
"""Long side, in pixels, of the picture that the imitated extractor searches."""
UNSEARCHED_BORDER_PX = 5.0
COARSEST_ZOOM = 0.6
"""Photograph pixels per pixel of a 256 frame: windows may be enlarged this much, as small crops are."""
_SEE_MARGIN = 0.07
_BBOX_REACH = 1.9


@dataclass(frozen=True)
class TrainingBatch:
    """One batch.

    chains: the network's input. source, target: float32 (B, n, 2), correspondences in the isotropic frame; weight:
    float32 (B, n). slopes: float32 (B, n, 2, 2), d source / d target. labels: float32 (B, 48) fitted node values.
    kind: int (B,) index into random_distortions.KINDS.
    """

    chains: ChainDescriptions
    source: Float32
    target: Float32
    weight: Float32
    slopes: Float32
    labels: Float32
    kind: Ints


@dataclass(frozen=True)
class _Windows:
    """How stored chains become a sample's: entry (B,) of the store; isotropic picture coordinates times scale (B,)
    plus shift (B, 2) are isotropic target coordinates; pixel (B,), isotropic size of a searched pixel."""

    entry: Ints
    scale_x: Float32
    scale_y: Float32
    shift: Float32
    pixel: Float32


class Sampler:
    """Draws batches from a store; all randomness comes from the generator passed in."""

    def __init__(
        self, store: ChainStore, drawn_share: float = 0.22, tilt_share: float = 0.1, square_share: float = 0.5
    ) -> None:
        self._store = store
        self._x = store.x.astype(np.float32) / np.float32(QUANTUM)
        self._y = store.y.astype(np.float32) / np.float32(QUANTUM)
        self._strength = store.strength.astype(np.float32)
        drawn = store.source == DRAWN
        self._drawn, self._photographs = np.flatnonzero(drawn), np.flatnonzero(~drawn)
        self._drawn_share = drawn_share if len(self._photographs) else 1.0
        self._tilt_share = tilt_share
        self._square_share = square_share

    def draw(self, size: int, rng: np.random.Generator, kinds: Ints | None = None) -> TrainingBatch:
        """A batch of `size` samples."""
        distortions = draw_distortions(size, rng, kinds)
        half_extent = self._half_extents(size, rng)
        points = self._points(distortions, half_extent, rng)
        source_x, source_y = evaluation_points(half_extent)
        target_x, target_y = distortions.straighten(source_x, source_y)
        slopes, area = _slopes(distortions, source_x, source_y)
        weight = evaluation_weights(target_x, target_y, area, half_extent)
        labels = fit_labels(source_x, source_y, target_x, target_y, weight)
        target = np.stack([target_x, target_y], -1).clip(-3, 3)
        return TrainingBatch(
            chains=describe(points),
            source=np.stack([source_x, source_y], -1).astype(np.float32),
            target=target.astype(np.float32),
            weight=weight.astype(np.float32),
            slopes=slopes.astype(np.float32),
            labels=labels.astype(np.float32),
            kind=distortions.kind,
        )

    def _half_extents(self, size: int, rng: np.random.Generator) -> Float64:
        common = rng.choice([4 / 3, 3 / 2, 16 / 9], size)
        aspect = np.where(rng.random(size) < 0.7, common, np.exp(rng.uniform(0, math.log(2.2), size)))
        aspect = np.where(rng.random(size) < self._square_share, 1.0, aspect)
        short = 1 / aspect
        portrait = rng.random(size) < 0.25
        return np.stack([np.where(portrait, short, 1.0), np.where(portrait, 1.0, short)], 1)

    def _points(self, distortions: DistortionBatch, half_extent: Float64, rng: np.random.Generator) -> ChainPoints:
        low, high = _target_bounds(distortions, half_extent)
        windows = self._windows(low, high, rng)
        x, y, strength, starts, sample = self._gather(windows.entry)
        x = x * windows.scale_x[sample] + windows.shift[sample, 0]
        y = y * windows.scale_y[sample] + windows.shift[sample, 1]
        low, high = (low - _SEE_MARGIN).astype(np.float32), (high + _SEE_MARGIN).astype(np.float32)
        near = (x > low[sample, 0]) & (x < high[sample, 0]) & (y > low[sample, 1]) & (y < high[sample, 1])
        x, y, strength, sample, starts = _kept(near, x, y, strength, sample, starts)
        x, y = _tilted(natural_tilts(distortions.size, self._tilt_share, rng), x, y, sample)
        x, y, visible = distortions.bend(x, y, sample)
        visible &= _extracted(x, y, strength, starts, sample, half_extent, rng)
        jitter = _jitter(windows.pixel, rng)[sample]
        x = x + jitter * rng.standard_normal(len(x), dtype=np.float32)
        y = y + jitter * rng.standard_normal(len(x), dtype=np.float32)
        inner = half_extent.astype(np.float32) - np.float32(UNSEARCHED_BORDER_PX) * windows.pixel[:, None]
        visible &= (np.abs(x) < inner[sample, 0]) & (np.abs(y) < inner[sample, 1])
        x, y, strength, sample, starts = _kept(visible, x, y, strength, sample, starts)
        return ChainPoints(x, y, strength, starts, sample, half_extent.astype(np.float32), windows.pixel)

    def _windows(self, low: Float64, high: Float64, rng: np.random.Generator) -> _Windows:
        """Where in which picture each sample looks, so that it sees the target rectangle low..high (B, 2)."""
        size = len(low)
        picture = self._pick(size, rng)
        extent_px = self._store.size_px[picture]
        span = high - low
        # Picture pixels per isotropic unit of the target frame, at which the needed rectangle just fits the picture.
        fitting = ((extent_px - 2) / span).min(1)
        floor = np.minimum(fitting, COARSEST_ZOOM * 128)
        zoom = fitting * (floor / fitting) ** rng.random(size)
        smallest, largest = SEARCHED_LONG_SIDE_PX
        varied = smallest * (largest / smallest) ** rng.random(size)
        searched = np.where(rng.random(size) < 0.5, smallest, varied)
        wanted_level = searched / 2 / zoom * np.exp(0.12 * rng.normal(size=size))
        level = np.abs(np.log(wanted_level[:, None] / np.array(LEVELS))).argmin(1)
        corner_px = 1 - extent_px / 2 + rng.random((size, 2)) * (extent_px - 2 - zoom[:, None] * span)
        scale = extent_px.max(1) / 2 / zoom
        mirrored = np.where(rng.random(size) < 0.5, -1, 1)
        return _Windows(
            entry=picture * len(LEVELS) + level,
            scale_x=(scale * mirrored).astype(np.float32),
            scale_y=scale.astype(np.float32),
            shift=(low - corner_px / zoom[:, None]).astype(np.float32),
            pixel=(2 / searched).astype(np.float32),
        )

    def _pick(self, size: int, rng: np.random.Generator) -> Ints:
        if not len(self._drawn):
            return self._photographs[rng.integers(len(self._photographs), size=size)]
        drawn = self._drawn[rng.integers(len(self._drawn), size=size)]
        if not len(self._photographs):
            return drawn
        photographs = self._photographs[rng.integers(len(self._photographs), size=size)]
        return np.where(rng.random(size) < self._drawn_share, drawn, photographs)

    def _gather(self, entries: Ints) -> tuple[Float32, Float32, Float32, Bools, Ints]:
        """The points of store entries (B,), flat: x, y (isotropic frame of the picture), strength, starts, sample."""
        first, last = self._store.offsets[entries], self._store.offsets[entries + 1]
        slices = [slice(a, b) for a, b in zip(first.tolist(), last.tolist(), strict=True)]
        sample = np.repeat(np.arange(len(entries)), last - first)
        return (
            np.concatenate([self._x[s] for s in slices]),
            np.concatenate([self._y[s] for s in slices]),
            np.concatenate([self._strength[s] for s in slices]),
            np.concatenate([self._store.starts[s] for s in slices]),
            sample,
        )


def _target_bounds(distortions: DistortionBatch, half_extent: Float64) -> tuple[Float64, Float64]:
    """Bounding box of what each picture shows, in its target frame: low, high (B, 2), within +-_BBOX_REACH."""
    steps = np.linspace(-1, 1, 11)
    grid_x, grid_y = (a.ravel() for a in np.meshgrid(steps, steps))
    x, y = distortions.straighten(half_extent[:, :1] * grid_x, half_extent[:, 1:] * grid_y)
    x, y = x.clip(-_BBOX_REACH, _BBOX_REACH), y.clip(-_BBOX_REACH, _BBOX_REACH)
    pad = 1 / 128
    return np.stack([x.min(1) - pad, y.min(1) - pad], 1), np.stack([x.max(1) + pad, y.max(1) + pad], 1)


def _slopes(distortions: DistortionBatch, x: Float64, y: Float64) -> tuple[Float64, Float64]:
    """d source / d target (B, n, 2, 2) and target area per source area (B, n), by central differences."""
    step = 1e-3
    right, left = distortions.straighten(x + step, y), distortions.straighten(x - step, y)
    below, above = distortions.straighten(x, y + step), distortions.straighten(x, y - step)
    a, c = ((right[i] - left[i]) / (2 * step) for i in (0, 1))
    b, d = ((below[i] - above[i]) / (2 * step) for i in (0, 1))
    area = a * d - b * c
    safe = np.where(np.abs(area) < 0.02, 0.02, area)
    inverse = np.stack([np.stack([d, -b], -1), np.stack([-c, a], -1)], -2) / safe[..., None, None]
    return inverse.clip(-4, 4), np.abs(area)


def _tilted(tilts: Float64, x: Float32, y: Float32, sample: Ints) -> tuple[Float32, Float32]:
    entries = tilts.astype(np.float32)
    depth = np.maximum(entries[sample, 2, 0] * x + entries[sample, 2, 1] * y + entries[sample, 2, 2], np.float32(0.2))
    tilted_x = (entries[sample, 0, 0] * x + entries[sample, 0, 1] * y + entries[sample, 0, 2]) / depth
    return tilted_x, (entries[sample, 1, 0] * x + entries[sample, 1, 1] * y + entries[sample, 1, 2]) / depth


def _jitter(pixel: Float32, rng: np.random.Generator) -> Float32:
    """Standard deviation (B,) of the noise added to each coordinate, isotropic; mostly small."""
    share = np.where(rng.random(len(pixel)) < 0.7, 0.12, 0.35) * rng.random(len(pixel))
    return (share * pixel).astype(np.float32)


def _extracted(
    x: Float32,
    y: Float32,
    strength: Float32,
    starts: Bools,
    sample: Ints,
    half_extent: Float64,
    rng: np.random.Generator,
) -> Bools:
    """Which points an imperfect extractor would still have found."""
    size = len(half_extent)
    chain = np.cumsum(starts) - 1
    first = np.flatnonzero(starts)
    owner = sample[first]
    missed_share = np.where(rng.random(size) < 0.5, rng.random(size) * 0.5, 0.0)
    missed = rng.random(len(first)) < missed_share[owner]
    faint_share = np.where(rng.random(size) < 0.3, rng.random(size) * 0.5, 0.0)
    order = np.lexsort((strength[first], owner))
    number = np.bincount(owner, minlength=size)
    rank = np.empty(len(first))
    rank[order] = np.arange(len(first)) - np.repeat(np.cumsum(number) - number, number)
    missed |= rank < faint_share[owner] * number[owner]
    centre = rng.uniform(-1, 1, (size, 2)) * half_extent
    radius = np.where(rng.random(size) < 0.15, rng.uniform(0.23, 0.86, size), 0.0)
    away_x, away_y = x - centre[:, 0].astype(np.float32)[sample], y - centre[:, 1].astype(np.float32)[sample]
    blank = away_x * away_x + away_y * away_y < (radius * radius).astype(np.float32)[sample]
    break_share = np.where(rng.random(size) < 0.6, rng.random(size) * 0.04, 0.0).astype(np.float32)
    broken = rng.random(len(x), dtype=np.float32) < break_share[sample]
    return np.asarray(~(missed[chain] | blank | broken))


def _kept(
    keep: Bools, x: Float32, y: Float32, strength: Float32, sample: Ints, starts: Bools
) -> tuple[Float32, Float32, Float32, Ints, Bools]:
    """The points that stay, with a chain starting anew after each gap."""
    chain = np.cumsum(starts)
    index = np.flatnonzero(keep)
    anew = np.ones(len(index), np.bool_)
    anew[1:] = (chain[index[1:]] != chain[index[:-1]]) | (index[1:] != index[:-1] + 1)
    return x[index], y[index], strength[index], sample[index], anew
