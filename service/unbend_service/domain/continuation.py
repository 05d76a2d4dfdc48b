"""A lattice continued beyond its frame: what a grid says of targets that it does not cover.

Nobody measured anything there. The continuation has to be smooth where a crop window grows a little past the frame,
and harmless where a window of the full picture reaches far: it follows the curvature of the lattice's outer quarter
as long as that cannot turn the map round, and then goes straight on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]

#: Targets further out than this lie on the straight continuation of the outermost cells.
_FARTHEST = 3.0
#: Bound of the relative change of pace per step (an eighth of the frame).
_LARGEST_BEND = 1.0
#: A coordinate so far outside the picture, in half picture widths, does not come nearer to it any more.
_BLENDED = 0.125


@dataclass(frozen=True, eq=False)
class ContinuedLattice:
    """Bilinear interpolation in a lattice with margins; as a callable, a backward map.

    Attributes:
        lattice: (rows + 2 row_margin, columns + 2 column_margin, 2) float64 centred source points.
        row_margin, column_margin: rows above and below, columns left and right, that lie outside the target frame.
    """

    lattice: Float64
    row_margin: int
    column_margin: int

    @classmethod
    def of(cls, source: npt.NDArray[np.floating], extent: float) -> ContinuedLattice:
        """Continues a (rows, columns, 2) lattice over targets in [-extent, extent]."""
        lattice = source.astype(np.float64)
        beyond = min(extent, _FARTHEST) - 1
        if beyond <= 0:
            return cls(lattice, 0, 0)
        row_margin, column_margin = (int(np.ceil(beyond / 2 * (count - 1))) + 1 for count in lattice.shape[:2])
        lattice = _continued(lattice, row_margin)
        lattice = _continued(lattice.transpose(1, 0, 2), column_margin).transpose(1, 0, 2)
        return cls(np.ascontiguousarray(lattice), row_margin, column_margin)

    def __call__(self, target: Float64) -> Float64:
        """(..., 2) float64 centred target points -> (..., 2) float64 centred source points."""
        first, width, u, v = self._cell(target)
        corner = self.lattice.reshape(-1, 2)
        top = corner[first] * (1 - u) + corner[first + 1] * u
        bottom = corner[first + width] * (1 - u) + corner[first + width + 1] * u
        return np.asarray(top * (1 - v) + bottom * v)

    def jacobian(self, target: Float64) -> Float64:
        """(n, 2) float64 target points -> (n, 2, 2) float64 derivatives, [:, i, j] = d source_i / d target_j."""
        first, width, u, v = self._cell(target)
        corner = self.lattice.reshape(-1, 2)
        a, b, c, d = corner[first], corner[first + 1], corner[first + width], corner[first + width + 1]
        height = len(self.lattice)
        cells_across, cells_down = (width - 2 * self.column_margin - 1) / 2, (height - 2 * self.row_margin - 1) / 2
        along_s = ((b - a) * (1 - v) + (d - c) * v) * cells_across
        along_t = ((c - a) * (1 - u) + (d - b) * u) * cells_down
        return np.stack([along_s, along_t], axis=-1)

    def _cell(self, target: Float64) -> tuple[npt.NDArray[np.intp], int, Float64, Float64]:
        """Index of the first corner of each target's cell, the stride of a row, and how far into the cell it lies."""
        height, width = self.lattice.shape[:2]
        column = (target[..., 0] + 1) / 2 * (width - 2 * self.column_margin - 1) + self.column_margin
        row = (target[..., 1] + 1) / 2 * (height - 2 * self.row_margin - 1) + self.row_margin
        c = np.clip(column, 0, width - 2).astype(np.intp)
        r = np.clip(row, 0, height - 2).astype(np.intp)
        return r * width + c, width, (column - c)[..., None], (row - r)[..., None]


def _continued(lattice: Float64, margin: int) -> Float64:
    """Adds ``margin`` rows before and after."""
    before = _beyond(lattice, margin)[::-1]
    return np.concatenate([before, lattice, _beyond(lattice[::-1], margin)])


def _beyond(lattice: Float64, margin: int) -> Float64:
    """(margin, columns, 2) rows outside ``lattice[0]``, nearest first.

    Let e, i, j be the edge and the points one and two steps (an eighth of the frame each) inside it, d1 and d2 the
    first and second difference of the parabola through them, outwards. d2 = a d1 + b n with n normal to d1. Along d1
    the parabola k + a k^2 / 2 is kept if it hastens (a >= 0); one that slackens would come back, so log(1 - a k) / -a
    takes its place, which has the same curvature at the edge, never turns and has no limit. Across, the parabola is
    left for its tangent after two steps.

    A coordinate that lies outside the picture at the edge may be an extrapolation already. It may grow but not come
    back, so that nothing comes into sight again out there; just outside, the bound sets in gradually.
    """
    distance = np.arange(1, margin + 1)[:, None, None]
    count = len(lattice)
    if count < 5:
        return np.asarray(lattice[0] + distance * (lattice[0] - lattice[1]))
    step = max(1, (count - 1) // 8)
    edge, inner, innermost = lattice[0], lattice[step], lattice[2 * step]
    pace = (3 * edge - 4 * inner + innermost) / 2
    change = edge - 2 * inner + innermost
    squared = np.maximum((pace**2).sum(axis=-1, keepdims=True), 1e-12)
    bend = np.clip((change * pace).sum(axis=-1, keepdims=True) / squared, -_LARGEST_BEND, _LARGEST_BEND)
    sideways = change - (change * pace).sum(axis=-1, keepdims=True) / squared * pace
    k = distance / step
    slackening = np.minimum(bend, -1e-6)
    along = np.where(bend >= 0, k + bend * k**2 / 2, np.log1p(-slackening * k) / -slackening)
    across = np.where(k <= 2, k**2 / 2, 2 * k - 2)
    curved = edge + along * pace + across * sideways
    far = np.abs(edge)
    bound = np.where(far < 1 + _BLENDED, 0.5 + (far - 1) * (0.5 + _BLENDED) / _BLENDED, far)
    return np.asarray(np.where(far > 1, np.sign(edge) * np.maximum(np.sign(edge) * curved, bound), curved))
