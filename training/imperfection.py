"""What extraction would have made of chains that were warped instead of the picture.

Chains come from the straight picture at one scale, the distorted picture has many: where a lens compresses, chains are
shorter and fewer, where it magnifies, edges are blurred, fainter and less exact. Besides, extraction misses chains,
breaks them, and is not exact to begin with.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from training.chain_store import LEVELS
from training.distortions import DistortionBatch

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]

_STEP = 2e-3


@dataclass(frozen=True)
class FlatPoints:
    """Chain points of a batch, flat, isotropic target or source frame.

    x, y, strength: float32 (n,). starts: bool (n,). sample: int (n,), index into the batch. level: int (n,), index into
    LEVELS of the search that found the chain. Points are in order of chains, not of samples.
    """

    x: Float32
    y: Float32
    strength: Float32
    starts: Bools
    sample: Ints
    level: Ints

    def moved(self, x: Float32, y: Float32) -> FlatPoints:
        """The same chains elsewhere."""
        return replace(self, x=x, y=y)

    def kept(self, keep: Bools) -> FlatPoints:
        """The points that stay, with a chain starting anew after each gap."""
        chain = np.cumsum(self.starts)
        index = np.flatnonzero(keep)
        anew = np.ones(len(index), np.bool_)
        anew[1:] = (chain[index[1:]] != chain[index[:-1]]) | (index[1:] != index[:-1] + 1)
        return FlatPoints(
            self.x[index], self.y[index], self.strength[index], anew, self.sample[index], self.level[index]
        )

    def by_sample(self) -> FlatPoints:
        """In order of samples; chains stay whole."""
        order = np.argsort(self.sample, kind="stable")
        return FlatPoints(
            self.x[order], self.y[order], self.strength[order], self.starts[order], self.sample[order],
            self.level[order],
        )  # fmt: skip


def at_the_right_level(
    points: FlatPoints, distortions: DistortionBatch, wanted_level: Float32
) -> tuple[FlatPoints, Float32]:
    """Of chains found at several scales, each where the distorted picture shows it at that scale; target frame.

    wanted_level: (B,), the scale of the store's pictures at which one of their pixels is one of the distorted picture,
    where the distortion neither magnifies nor compresses. Returns the chains that stay, their strengths as blurred by
    magnification, and per point the factor >= 1 by which it is magnified beyond the scale it was found at.
    """
    if len(points.x) == 0:
        return points, np.ones(0, np.float32)
    first = np.flatnonzero(points.starts)
    count = np.diff(np.append(first, len(points.x)))
    middle = first + count // 2
    x, y, sample = points.x[middle], points.y[middle], points.sample[middle]
    here, right, below = (
        distortions.bend(x + np.float32(dx), y + np.float32(dy), sample) for dx, dy in ((0, 0), (_STEP, 0), (0, _STEP))
    )
    area = (right[0] - here[0]) * (below[1] - here[1]) - (right[1] - here[1]) * (below[0] - here[0])
    stretch = np.sqrt(np.abs(area)) / np.float32(_STEP)
    wanted = wanted_level[sample] * stretch.clip(0.05, 20)
    nearest = np.abs(np.log(wanted)[:, None] - np.log(np.array(LEVELS, np.float32))[None]).argmin(1)
    blur = np.maximum(wanted / np.array(LEVELS, np.float32)[points.level[middle]], 1)
    faintest = np.full(distortions.size, np.inf, np.float32)
    np.minimum.at(faintest, sample, points.strength[middle])
    stays = (nearest == points.level[middle]) & (points.strength[middle] / blur > 0.4 * faintest[sample])
    blurred = replace(points, strength=points.strength / np.repeat(blur, count))
    return blurred.kept(np.repeat(stays, count)), np.repeat(blur[stays], count[stays])


def found(points: FlatPoints, half_extent: Float64, rng: np.random.Generator) -> Bools:
    """Which points (n,), in the source frame, an imperfect extractor would still have found."""
    size, sample = len(half_extent), points.sample
    chain = np.cumsum(points.starts) - 1
    first = np.flatnonzero(points.starts)
    owner = sample[first]
    missed_share = np.where(rng.random(size) < 0.5, rng.random(size) * 0.5, 0.0)
    # Fields and fog: with hardly a chain to go by, the network has to learn to hold back.
    missed_share = np.where(rng.random(size) < 0.06, rng.uniform(0.7, 0.97, size), missed_share)
    missed = rng.random(len(first)) < missed_share[owner]
    faint_share = np.where(rng.random(size) < 0.3, rng.random(size) * 0.5, 0.0)
    order = np.lexsort((points.strength[first], owner))
    number = np.bincount(owner, minlength=size)
    rank = np.empty(len(first))
    rank[order] = np.arange(len(first)) - np.repeat(np.cumsum(number) - number, number)
    missed |= rank < faint_share[owner] * number[owner]
    centre = (rng.uniform(-1, 1, (size, 2)) * half_extent).astype(np.float32)
    radius = np.where(rng.random(size) < 0.15, rng.uniform(0.23, 0.86, size), 0.0)
    away_x = points.x - np.ascontiguousarray(centre[:, 0])[sample]
    away_y = points.y - np.ascontiguousarray(centre[:, 1])[sample]
    blank = away_x * away_x + away_y * away_y < (radius * radius).astype(np.float32)[sample]
    break_share = np.where(rng.random(size) < 0.6, rng.random(size) * 0.04, 0.0).astype(np.float32)
    broken = rng.random(len(points.x), dtype=np.float32) < break_share[sample]
    return np.asarray(~(missed[chain] | blank | broken))


def jitter(pixel: Float32, rng: np.random.Generator) -> Float32:
    """Standard deviation (B,) of the noise added to each coordinate, isotropic; mostly small."""
    share = np.where(rng.random(len(pixel)) < 0.7, 0.12, 0.35) * rng.random(len(pixel))
    return np.asarray(share * pixel, np.float32)
