"""What the line-set network is told about each edge chain: a fixed-length description, numpy only.

Training imports this module, so that a network never meets features computed differently from those it learned on.
Everything is computed in the isotropic frame (see `chains`); lengths are stated in *reference pixels*, 1/128 of an
isotropic unit, which is one pixel when the long side has 256.

A chain is read from left to right, or top to bottom when it is closer to the vertical, so that its description does
not depend on the direction in which it was traced.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from unbend_service.adapters.estimators.chains import EdgeChains

FloatArray = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

REFERENCE = 128.0
"""Reference pixels per isotropic unit."""
CHAIN_LIMIT = 112
"""Longest chains kept per picture."""
SAMPLES = 12
MINIMUM_POINTS = 4
MINIMUM_ARC_PX = 11.0
"""In pixels of the picture that was searched: what the tracer's 16 px leave after smoothing."""
LEGENDRE_DEGREE = 4
FEATURES = 3 * SAMPLES + 8 + 2 + 4 + 12 + 1 + 4 + 4

_PARAMETER = np.linspace(0.0, 1.0, SAMPLES, dtype=np.float32)
_FIT_RIDGE = np.array([0.0, 0.0, 0.02, 0.05, 0.1])
"""Shrinks the higher Legendre coefficients of chains with few points, in units of one point's worth of evidence."""


@dataclass(frozen=True)
class ChainPoints:
    """Chain points of a batch of pictures, flat, isotropic frame.

    x, y, strength: float32 (n,). starts: bool (n,). picture: int (n,), non-decreasing index into the batch.
    half_extent: float32 (batch, 2), half width and half height. pixel: float32 (batch,), size of a searched pixel.
    """

    x: FloatArray
    y: FloatArray
    strength: FloatArray
    starts: BoolArray
    picture: IntArray
    half_extent: FloatArray
    pixel: FloatArray

    @property
    def batch_size(self) -> int:
        return len(self.pixel)

    @staticmethod
    def of(chains: EdgeChains) -> ChainPoints:
        """A batch of one picture."""
        return ChainPoints(
            chains.x,
            chains.y,
            chains.strength,
            chains.starts,
            np.zeros(len(chains.x), np.int64),
            np.array([[chains.half_width, chains.half_height]], np.float32),
            np.array([chains.pixel], np.float32),
        )

    def mirrored(self) -> ChainPoints:
        """The same pictures seen in a mirror: x -> -x."""
        return ChainPoints(-self.x, self.y, self.strength, self.starts, self.picture, self.half_extent, self.pixel)

    def moved(self, x: FloatArray, y: FloatArray) -> ChainPoints:
        """The same chains elsewhere."""
        return replace(self, x=x, y=y)

    def kept(self, keep: BoolArray) -> ChainPoints:
        """The points that stay, with a chain starting anew after each gap."""
        chain = np.cumsum(self.starts)
        index = np.flatnonzero(keep)
        anew = np.ones(len(index), np.bool_)
        anew[1:] = (chain[index[1:]] != chain[index[:-1]]) | (index[1:] != index[:-1] + 1)
        return replace(
            self,
            x=self.x[index],
            y=self.y[index],
            strength=self.strength[index],
            starts=anew,
            picture=self.picture[index],
        )


@dataclass(frozen=True)
class ChainDescriptions:
    """Descriptions of the chains that were kept, flat; sorted by picture, longest chain first.

    features: float32 (m, FEATURES). picture: int (m,). slot: int (m,), rank within the picture, < CHAIN_LIMIT.
    """

    features: FloatArray
    picture: IntArray
    slot: IntArray
    batch_size: int

    def padded(self, slots: int = CHAIN_LIMIT) -> tuple[FloatArray, FloatArray]:
        """features (batch, slots, FEATURES) and mask (batch, slots), 1 where a chain is; both float32."""
        features = np.zeros((self.batch_size, slots, FEATURES), np.float32)
        mask = np.zeros((self.batch_size, slots), np.float32)
        features[self.picture, self.slot] = self.features
        mask[self.picture, self.slot] = 1.0
        return features, mask


@dataclass(frozen=True)
class _Segments:
    """Kept chains and their points, contiguous: first, last and count index the points."""

    x: FloatArray
    y: FloatArray
    arc: FloatArray
    first: IntArray
    last: IntArray
    length: FloatArray
    strength: FloatArray
    picture: IntArray
    slot: IntArray


def describe(points: ChainPoints, limit: int = CHAIN_LIMIT) -> ChainDescriptions:
    """Descriptions of the `limit` longest chains of each picture."""
    segments = _select(points, limit)
    if segments is None:
        nothing = np.zeros(0, np.int64)
        return ChainDescriptions(np.zeros((0, FEATURES), np.float32), nothing, nothing, points.batch_size)
    return ChainDescriptions(_features(segments, points), segments.picture, segments.slot, points.batch_size)


def _select(points: ChainPoints, limit: int) -> _Segments | None:
    if len(points.x) == 0:
        return None
    first = np.flatnonzero(points.starts)
    count = np.diff(np.append(first, len(points.x)))
    step = np.zeros(len(points.x), np.float64)
    step[1:] = np.hypot(np.diff(points.x), np.diff(points.y))
    step[first] = 0.0
    arc = np.cumsum(step)
    length = arc[first + count - 1] - arc[first]
    picture = points.picture[first]
    kept = np.flatnonzero((count >= MINIMUM_POINTS) & (length >= MINIMUM_ARC_PX * points.pixel[picture]))
    if len(kept) == 0:
        return None
    kept = kept[np.lexsort((-length[kept], picture[kept]))]
    sorted_picture = picture[kept]
    opens = np.ones(len(kept), np.bool_)
    opens[1:] = sorted_picture[1:] != sorted_picture[:-1]
    slot = np.arange(len(kept)) - np.flatnonzero(opens)[np.cumsum(opens) - 1]
    kept, slot = kept[slot < limit], slot[slot < limit]
    first, count = first[kept], count[kept]
    new_first = np.cumsum(count) - count
    index = np.arange(int(count.sum())) - np.repeat(new_first, count) + np.repeat(first, count)
    scaled_arc = ((arc[index] - np.repeat(arc[first], count)) * REFERENCE).astype(np.float32)
    return _Segments(
        points.x[index] * np.float32(REFERENCE),
        points.y[index] * np.float32(REFERENCE),
        scaled_arc,
        new_first,
        new_first + count - 1,
        (length[kept] * REFERENCE).astype(np.float32),
        points.strength[first + count // 2],
        picture[kept],
        slot,
    )


def _features(chains: _Segments, points: ChainPoints) -> FloatArray:
    sample_x, sample_y, reverse = _resampled(chains)
    centre_x, centre_y = sample_x.mean(1), sample_y.mean(1)
    from_x, from_y = sample_x - centre_x[:, None], sample_y - centre_y[:, None]
    angle = 0.5 * np.arctan2(2 * (from_x * from_y).sum(1), (from_x * from_x).sum(1) - (from_y * from_y).sum(1))
    cos, sin = np.cos(angle), np.sin(angle)
    flip = np.where(np.where(np.abs(cos) >= np.abs(sin), cos < 0, sin < 0), np.float32(-1), np.float32(1))
    cos, sin = cos * flip, sin * flip
    offset = cos[:, None] * from_y - sin[:, None] * from_x
    legendre, noise = _legendre(chains, centre_x, centre_y, cos, sin, reverse)
    near_horizontal = np.abs(cos) >= np.abs(sin)
    deviation = np.degrees(np.where(near_horizontal, np.arctan2(sin, cos), np.arctan2(-cos, sin)))
    length = chains.length
    x, y = centre_x / np.float32(REFERENCE), centre_y / np.float32(REFERENCE)
    along, across = cos * x + sin * y, cos * y - sin * x
    shape = np.stack(
        [
            np.arcsinh(legendre[:, 2] / 0.3),
            np.arcsinh(legendre[:, 3] / 0.3),
            np.arcsinh(noise / 0.15),
            legendre[:, 2] / length * 40,
            legendre[:, 3] / length * 40,
            legendre[:, 2] * (1200 / length**2),
            length / 128,
            np.log(length / 25),
        ],
        1,
    ).clip(-6, 6)
    place = np.stack(
        [
            x,
            y,
            x * x,
            y * y,
            x * y,
            np.sin(math.pi * x),
            np.cos(math.pi * x),
            np.sin(math.pi * y),
            np.cos(math.pi * y),
            np.sin(2 * math.pi * x),
            np.sin(2 * math.pi * y),
            (x * x + y * y) * across,
        ],
        1,
    )
    log_strength = np.log(np.maximum(chains.strength, 1.0))
    total = np.bincount(chains.picture, log_strength, points.batch_size)
    number = np.maximum(np.bincount(chains.picture, minlength=points.batch_size), 1)
    contrast = (log_strength - (total / number)[chains.picture]).clip(-2, 2)
    extent = points.half_extent[chains.picture]
    pixel = points.pixel[chains.picture] * REFERENCE
    return np.concatenate(
        [
            sample_x / REFERENCE,
            sample_y / REFERENCE,
            np.arcsinh(offset / 0.5),
            shape,
            near_horizontal[:, None],
            np.arcsinh(deviation / 2.0)[:, None],
            np.stack([cos * cos - sin * sin, 2 * sin * cos, along, across], 1),
            place,
            contrast[:, None],
            np.stack(
                [
                    np.arcsinh(legendre[:, 4] / 0.3),
                    np.arcsinh(legendre[:, 2] / 0.05) / 3,
                    np.arcsinh(legendre[:, 3] / 0.05) / 3,
                    np.log(number[chains.picture] / 40.0),
                ],
                1,
            ),
            1 - extent,
            np.log(pixel)[:, None],
            1 / np.sqrt(length)[:, None] * 5,
        ],
        1,
    ).astype(np.float32)


def _resampled(chains: _Segments) -> tuple[FloatArray, FloatArray, BoolArray]:
    """SAMPLES points evenly spaced along each chain, in reading direction: x, y (m, SAMPLES), reversed (m,)."""
    span_x = chains.x[chains.last] - chains.x[chains.first]
    span_y = chains.y[chains.last] - chains.y[chains.first]
    reverse = np.where(np.abs(span_x) >= np.abs(span_y), span_x < 0, span_y < 0)
    share = np.where(reverse[:, None], 1 - _PARAMETER, _PARAMETER)
    # One search over all chains: each chain's arc is shifted past the end of the one before it.
    room = chains.length.astype(np.float64) + 1.0
    shift = np.cumsum(room) - room
    counts = chains.last - chains.first + 1
    global_arc = chains.arc + np.repeat(shift, counts)
    wanted = shift[:, None] + share * chains.length[:, None].astype(np.float64)
    right = np.searchsorted(global_arc, wanted.ravel()).reshape(wanted.shape)
    right = right.clip(chains.first[:, None] + 1, chains.last[:, None])
    gap = np.maximum(global_arc[right] - global_arc[right - 1], 1e-6)
    weight = ((wanted - global_arc[right - 1]) / gap).astype(np.float32)
    x = chains.x[right - 1] + (chains.x[right] - chains.x[right - 1]) * weight
    y = chains.y[right - 1] + (chains.y[right] - chains.y[right - 1]) * weight
    return x, y, reverse


def _legendre(
    chains: _Segments, centre_x: FloatArray, centre_y: FloatArray, cos: FloatArray, sin: FloatArray, reverse: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Legendre coefficients (m, 5) of the offset across each chain over its arc, from ALL its points, and the rms
    of what they leave, (m,); reference pixels.

    All points rather than the samples: a long chain's bend is then known several times better than one point is.
    """
    counts = chains.last - chains.first + 1
    spread = np.repeat(np.arange(len(counts)), counts)
    offset = cos[spread] * (chains.y - centre_y[spread]) - sin[spread] * (chains.x - centre_x[spread])
    z = 2 * chains.arc / np.repeat(chains.length, counts) - 1
    z = np.where(reverse[spread], -z, z).astype(np.float32)
    z2 = z * z
    basis = np.stack([np.ones_like(z), z, 1.5 * z2 - 0.5, (2.5 * z2 - 1.5) * z, (4.375 * z2 - 3.75) * z2 + 0.375])
    size = LEGENDRE_DEGREE + 1
    gram = np.empty((len(counts), size, size), np.float64)
    moment = np.empty((len(counts), size), np.float64)
    for i in range(size):
        moment[:, i] = np.add.reduceat(basis[i] * offset, chains.first)
        for j in range(i + 1):
            gram[:, i, j] = gram[:, j, i] = np.add.reduceat(basis[i] * basis[j], chains.first)
    gram += np.diag(_FIT_RIDGE + 1e-6)
    coefficients = np.linalg.solve(gram, moment[..., None])[..., 0].astype(np.float32)
    residual = offset - (basis * coefficients[spread].T).sum(0)
    noise = np.sqrt(np.add.reduceat(residual * residual, chains.first) / counts)
    return coefficients, noise.astype(np.float32)
