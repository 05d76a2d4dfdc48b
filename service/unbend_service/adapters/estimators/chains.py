"""Sub-pixel edge chains: ordered points along the edges of a grey picture.

The steps, each one function below: Scharr gradient -> Canny -> thinning of L corners and removal of junction
pixels, so that what remains are simple curves -> ordering of each curve by list ranking (pointer jumping, which
takes log2(length) vector operations instead of a walk pixel by pixel) -> parabola across the edge for the sub-pixel
offset -> split where the direction turns -> five-tap smoothing and thinning out.

About 8 ms for a 256x256 picture on one core; numpy and OpenCV only.

Frame. Chains leave this module in the **isotropic frame**: origin at the picture's centre, x to the right, y down,
one unit = half the LONG side, so x = (2 (i + 0.5) - W) / max(W, H), y = (2 (j + 0.5) - H) / max(W, H). For a square
picture it is the centred frame; for any other, angles and circles keep their shape, which the centred frame would
not grant and a lens needs. x_centred = x_isotropic / half_width, y_centred = y_isotropic / half_height.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

BORDER_PX = 3
"""Canny's response is unreliable this close to the picture's edge."""
MINIMUM_LENGTH_PX = 16
CORNER_REACH_PX = 6
CORNER_TURN_DEGREES = 22.0
STRONG_EDGE_PERCENTILE = 80.0
STRONG_EDGE_FLOOR = 38.0
"""In units of the 3x3 Scharr sum (32 = one grey level per pixel): below it edges are sensor noise."""
WEAK_EDGE_SHARE = 0.45
KEEP_EVERY = 3

_NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1), (0, -1), (-1, 0), (-1, -1), (-1, 1))


@dataclass(frozen=True)
class EdgeChains:
    """Flat, ordered chain points of one picture, in the isotropic frame.

    x, y: float32 (n,), isotropic frame. strength: float32 (n,), gradient magnitude in Scharr units.
    starts: bool (n,), True at the first point of each chain.
    half_width, half_height: extent of the picture in the isotropic frame; the larger is 1.
    pixel: size of one pixel of the picture that was searched, in isotropic units.
    """

    x: FloatArray
    y: FloatArray
    strength: FloatArray
    starts: BoolArray
    half_width: float
    half_height: float
    pixel: float

    @property
    def count(self) -> int:
        """Number of chains."""
        return int(self.starts.sum())


def fit_long_side(grey: npt.NDArray[np.uint8], long_side_px: int) -> npt.NDArray[np.uint8]:
    """The picture reduced (never enlarged) so that its long side is at most `long_side_px`; uint8 (h, w)."""
    height, width = grey.shape
    scale = long_side_px / max(height, width)
    if scale >= 1.0:
        return grey
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def extract(grey: npt.NDArray[np.uint8]) -> EdgeChains:
    """Edge chains of a grey picture, uint8 (h, w), at the resolution given (256 to 384 px is what estimators want)."""
    height, width = grey.shape
    half = max(height, width) / 2.0
    points = _trace(grey) if min(height, width) > 2 * (BORDER_PX + 2) else None
    points = _smooth(*points) if points is not None else None
    x, y, strength, starts = points if points is not None else _nothing()
    return EdgeChains(
        x=((x + np.float32(0.5 - width / 2.0)) / np.float32(half)).astype(np.float32),
        y=((y + np.float32(0.5 - height / 2.0)) / np.float32(half)).astype(np.float32),
        strength=strength,
        starts=starts,
        half_width=width / 2.0 / half,
        half_height=height / 2.0 / half,
        pixel=1.0 / half,
    )


_Points = tuple[FloatArray, FloatArray, FloatArray, BoolArray]


def _nothing() -> _Points:
    empty = np.zeros(0, np.float32)
    return empty, empty, empty, np.zeros(0, np.bool_)


def _trace(grey: npt.NDArray[np.uint8]) -> _Points | None:
    """Every pixel of every chain, ordered, with its sub-pixel position in pixel index coordinates."""
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.0).astype(np.float32)
    gradient_x = np.asarray(cv2.Scharr(smooth, cv2.CV_32F, 1, 0), np.float32)
    gradient_y = np.asarray(cv2.Scharr(smooth, cv2.CV_32F, 0, 1), np.float32)
    # Not cv2.magnitude: its last bits follow the addresses of its arguments, and an estimate has to be repeatable.
    magnitude = np.sqrt(gradient_x * gradient_x + gradient_y * gradient_y)
    edges = _simple_edges(gradient_x, gradient_y, magnitude)
    columns, rows, chain, along = _ordered_pixels(edges)
    if len(columns) == 0:
        return None
    order = np.argsort(chain * len(chain) + along, kind="stable")
    columns, rows, chain = columns[order], rows[order], chain[order]
    x, y, strength = _subpixel(columns, rows, gradient_x, gradient_y, magnitude)
    return _split_at_corners(x, y, strength, chain)


def _simple_edges(gradient_x: FloatArray, gradient_y: FloatArray, magnitude: FloatArray) -> BoolArray:
    """Canny edges in which no pixel has more than two neighbours: bool (h, w)."""
    strong = max(float(np.percentile(magnitude[::2, ::2], STRONG_EDGE_PERCENTILE)), STRONG_EDGE_FLOOR)
    edges: BoolArray = (
        np.asarray(
            cv2.Canny(
                gradient_x.clip(-32000, 32000).astype(np.int16),
                gradient_y.clip(-32000, 32000).astype(np.int16),
                WEAK_EDGE_SHARE * strong,
                strong,
                L2gradient=True,
            )
        )
        > 0
    )
    edges[:BORDER_PX] = edges[-BORDER_PX:] = False
    edges[:, :BORDER_PX] = edges[:, -BORDER_PX:] = False
    inner, above, below = edges[1:-1, 1:-1], edges[:-2, 1:-1], edges[2:, 1:-1]
    left, right = edges[1:-1, :-2], edges[1:-1, 2:]
    for vertical, across in ((below, right), (above, left), (below, left), (above, right)):
        # The corner pixel of an L can go: its two 4-neighbours stay connected diagonally.
        corner = vertical & across
        corner &= (above ^ below) & (left ^ right)
        inner ^= inner & corner
    crowd = cv2.boxFilter(edges.astype(np.uint8), cv2.CV_8U, (3, 3), normalize=False)
    return edges & (np.asarray(crowd) <= 3)


def _links(rows: IntArray, columns: IntArray, shape: tuple[int, int]) -> tuple[IntArray, IntArray]:
    """The (at most two) neighbours of each edge pixel as indices, -1 for none: (n, 2); and their number: (n,)."""
    count = len(rows)
    index_of = np.full(shape[0] * shape[1], -1, np.int64)
    flat = rows * shape[1] + columns
    index_of[flat] = np.arange(count)
    candidates = index_of[flat + np.array([[down * shape[1] + right] for down, right in _NEIGHBOURS])]
    found = candidates >= 0
    degree = found.sum(0)
    neighbours = np.empty((count, 2), np.int64)
    pixel = np.arange(count)
    for link in (0, 1):
        nearest = found.argmax(0)
        neighbours[:, link] = np.where(degree > link, candidates[nearest, pixel], -1)
        found[nearest, pixel] = False
    return neighbours, degree


def _ordered_pixels(edges: BoolArray) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Edge pixels with, for each, its chain and its rank along the chain: columns, rows, chain, rank, all (n,)."""
    labels_count, labels = cv2.connectedComponents(edges.astype(np.uint8), connectivity=8)
    rows, columns = np.divmod(np.flatnonzero(edges), edges.shape[1])  # np.nonzero takes three times as long
    label = np.asarray(labels)[rows, columns].astype(np.int64)
    size = np.bincount(label, minlength=labels_count)
    long_enough = size[label] >= MINIMUM_LENGTH_PX
    rows, columns, label = rows[long_enough], columns[long_enough], label[long_enough]
    none = np.zeros(0, np.int64)
    if len(rows) == 0:
        return none, none, none, none
    neighbours, degree = _links(rows, columns, edges.shape)
    has_end = np.bincount(label, degree <= 1, minlength=labels_count) > 0
    closed = ~has_end[label]
    if closed.any():
        # A closed curve is cut open at one pixel, so that every curve has two ends.
        _, first = np.unique(np.where(closed, label, -1), return_index=True)
        kept = np.ones(len(rows), np.bool_)
        kept[first[closed[first]]] = False
        rows, columns = rows[kept], columns[kept]
        neighbours = _without(neighbours, kept)
    ends, distance = _list_ranking(neighbours, int(size.max()))
    from_first = ends[:, 0] <= ends[:, 1]
    chain = np.where(from_first, ends[:, 0], ends[:, 1])
    rank = np.where(from_first, distance[:, 0], distance[:, 1])
    return columns, rows, chain, rank


def _without(neighbours: IntArray, kept: BoolArray) -> IntArray:
    """The links among the pixels that are kept."""
    number = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1)  # the last one is that of no pixel
    first, second = number[neighbours[kept]].T
    return np.stack([np.where(first < 0, second, first), np.where(first < 0, -1, second)], axis=1)


def _list_ranking(neighbours: IntArray, longest: int) -> tuple[IntArray, IntArray]:
    """End pixel reached, and steps to it, leaving each pixel through either of its two links: both (n, 2).

    Pointer jumping over the states 2 pixel + link: each round doubles the distance looked ahead.
    """
    pixel = np.repeat(np.arange(len(neighbours)), 2)
    link = np.tile(np.array([0, 1]), len(neighbours))
    ahead = neighbours[pixel, link]
    has_next = ahead >= 0
    safe = np.where(has_next, ahead, pixel)
    back_link = np.where(neighbours[safe, 0] == pixel, 0, 1)
    following = np.where(has_next, 2 * safe + (1 - back_link), 2 * pixel + link)
    distance = has_next.astype(np.int64)
    for _ in range(int(np.ceil(np.log2(max(longest, 2)))) + 1):
        distance += distance.take(following)
        following = following.take(following)
    return (following >> 1).reshape(-1, 2), distance.reshape(-1, 2)


def _subpixel(
    columns: IntArray, rows: IntArray, gradient_x: FloatArray, gradient_y: FloatArray, magnitude: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Parabola through the gradient magnitude one pixel to either side, across the edge."""
    flat = rows * magnitude.shape[1] + columns
    here = magnitude.ravel()[flat]
    across_x = gradient_x.ravel()[flat] / (here + np.float32(1e-6))
    across_y = gradient_y.ravel()[flat] / (here + np.float32(1e-6))
    x, y = columns.astype(np.float32), rows.astype(np.float32)
    before = _sampled(magnitude, x - across_x, y - across_y)
    after = _sampled(magnitude, x + across_x, y + across_y)
    curvature = before - 2 * here + after
    bent = np.abs(curvature) > 1e-6
    offset = np.where(bent, 0.5 * (before - after) / np.where(bent, curvature, 1), 0).clip(-0.7, 0.7)
    offset = offset.astype(np.float32)
    return x + across_x * offset, y + across_y * offset, here


def _sampled(image: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """Bilinear samples of `image` at pixel index coordinates, (n,)."""
    width = 1024  # cv2.remap takes no side beyond 32,767, hence the folding
    count = len(x)
    padded = -count % width
    map_x, map_y = (np.pad(a, (0, padded)).reshape(-1, width) for a in (x, y))
    return np.asarray(cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR), np.float32).reshape(-1)[:count]


def _split_at_corners(x: FloatArray, y: FloatArray, strength: FloatArray, chain: IntArray) -> _Points | None:
    count, reach = len(x), CORNER_REACH_PX
    starts = np.ones(count, np.bool_)
    starts[1:] = chain[1:] != chain[:-1]
    corner = np.zeros(count, np.bool_)
    if count > 2 * reach:
        i = np.arange(reach, count - reach)
        inside = chain[i - reach] == chain[i + reach]
        in_x, in_y = x[i] - x[i - reach], y[i] - y[i - reach]
        out_x, out_y = x[i + reach] - x[i], y[i + reach] - y[i]
        turn = np.abs(in_x * out_y - in_y * out_x)
        straight = np.maximum(in_x * out_x + in_y * out_y, 1e-6)
        corner[i] = inside & (turn > np.tan(np.radians(CORNER_TURN_DEGREES)) * straight)
    starts |= corner
    starts[1:] |= corner[:-1]
    piece = np.cumsum(starts) - 1
    size = np.bincount(piece)  # a piece whose ends nearly meet cannot have been straight: it goes by its span
    first = np.flatnonzero(starts)
    last = first + size - 1
    span = np.hypot(x[last] - x[first], y[last] - y[first])
    keep = ((size >= MINIMUM_LENGTH_PX) & ~corner[first] & (span > 0.8 * MINIMUM_LENGTH_PX))[piece]
    return (x[keep], y[keep], strength[keep], starts[keep]) if keep.any() else None


def _smooth(x: FloatArray, y: FloatArray, strength: FloatArray, starts: BoolArray) -> _Points | None:
    """Five-tap mean inside each chain (which loses two points at either end), then every third point."""
    chain = np.cumsum(starts) - 1
    i = np.arange(2, len(x) - 2)
    i = i[chain[i - 2] == chain[i + 2]]
    if len(i) == 0:
        return None

    def mean(a: FloatArray) -> FloatArray:
        return np.asarray((a[i - 2] + a[i - 1] + a[i] + a[i + 1] + a[i + 2]) * np.float32(0.2))

    x, y, strength, chain = mean(x), mean(y), mean(strength), chain[i]
    first = np.ones(len(chain), np.bool_)
    first[1:] = chain[1:] != chain[:-1]
    rank = np.arange(len(chain)) - np.flatnonzero(first)[np.cumsum(first) - 1]
    kept = rank % KEEP_EVERY == 0
    chain = chain[kept]
    starts = np.ones(len(chain), np.bool_)
    starts[1:] = chain[1:] != chain[:-1]
    return x[kept], y[kept], strength[kept], starts
