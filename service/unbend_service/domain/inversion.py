"""The inverse of a grid: where each point of the distorted picture lies in the corrected one.

A grid is the backward map of the correction, target -> source. Its inverse, source -> target, bends a straight picture
the way the lens did (redistorts), and tells where a source point goes.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from unbend_service.domain.continuation import ContinuedLattice
from unbend_service.domain.errors import InvalidGrid
from unbend_service.domain.grid import MAX_POINTS, MAX_SOURCE, Grid, cell_orientations
from unbend_service.domain.maps import Float64, target_lattice

#: How far beyond the target frame sources are looked for, in half picture widths.
INVERSION_EXTENT = 3.0
_SEARCH_POINTS = 193
_BINS = 96
#: Sources so far outside the picture still get a start of their own; others start from the nearest that has one.
_BINNED = 1.25
#: Half picture widths; 0.016 px in a picture of 8192.
_TOLERANCE = 4e-6
_STEPS = 30


class InverseMap:
    """Source -> target of a grid; as a callable, the backward map of the redistortion.

    The start of each point is the nearest of the sampled forward map; damped Newton steps inside the cells of the
    continued lattice (which is bilinear, so its Jacobian is known in closed form) bring the source of the target to
    within 0.016 px of an 8192 pixel wide picture wherever the map can be inverted. A source point that no target
    shows is given the target whose source came nearest to it.

    Args:
        grid: target -> source, unfolded.

    Raises:
        FoldedGrid: the map turns over itself over the visible part, so it has no inverse.
        InvalidGrid: no part of the target shows the source.
    """

    def __init__(self, grid: Grid) -> None:
        grid.check_unfolded()
        self._forward = grid.continued(INVERSION_EXTENT)
        self._starts = _starts(self._forward)
        centres = target_lattice(_BINS, _BINS, _BINNED * (1 - 1 / _BINS)).reshape(-1, 2)
        # refined once here, so that most points need a single step later
        self._starts = self._solved(centres, self._starts.reshape(-1, 2).copy()).reshape(self._starts.shape)

    def __call__(self, source: Float64) -> Float64:
        """(..., 2) float64 centred source points -> (..., 2) float64 centred target points."""
        source = np.asarray(source, dtype=np.float64)
        wanted = source.reshape(-1, 2)
        return self._solved(wanted, self._start_of(wanted)).reshape(source.shape)

    def _start_of(self, source: Float64) -> Float64:
        """Bilinear between the centres of the bins."""
        position = np.clip((source / _BINNED + 1) / 2 * _BINS - 0.5, 0, _BINS - 1)
        cell = np.minimum(position.astype(np.intp), _BINS - 2)
        u, v = (position - cell)[:, :1], (position - cell)[:, 1:]
        column, row = cell[:, 0], cell[:, 1]
        starts = self._starts
        top = starts[row, column] * (1 - u) + starts[row, column + 1] * u
        bottom = starts[row + 1, column] * (1 - u) + starts[row + 1, column + 1] * u
        return np.asarray(top * (1 - v) + bottom * v)

    def _solved(self, source: Float64, target: Float64) -> Float64:
        error = self._forward(target) - source
        size = np.abs(error).max(axis=1, initial=0)
        active = np.flatnonzero(size > _TOLERANCE)
        damping = np.ones(len(source))
        for _ in range(_STEPS):
            if not len(active):
                break
            step = _newton_step(self._forward, target[active], error[active]) * damping[active, None]
            tried = np.clip(target[active] - step, -MAX_SOURCE, MAX_SOURCE)
            tried_error = self._forward(tried) - source[active]
            tried_size = np.abs(tried_error).max(axis=1)
            better = tried_size < size[active]
            taken = active[better]
            target[taken], error[taken], size[taken] = tried[better], tried_error[better], tried_size[better]
            damping[taken] = np.minimum(1, 2 * damping[taken])
            damping[active[~better]] /= 4
            active = active[(size[active] > _TOLERANCE) & (damping[active] > 1e-3)]
        return target


def inverse(grid: Grid, rows: int | None = None, columns: int | None = None) -> Grid:
    """The grid that undoes ``grid``: its lattice lies over the distorted picture, its points in the corrected one.

    Rendering with it redistorts. ``inverse(grid)(grid(t))`` is ``t`` to within the bilinear error of the lattice where
    ``t`` is visible; :class:`InverseMap` is exact. Points that the corrected frame does not show (a crop) lie outside
    [-1, 1] and follow the continuation of the grid.

    Args:
        rows, columns: of the result; cells half as long as those of ``grid`` if left out, at most MAX_POINTS.

    Raises:
        FoldedGrid, InvalidGrid: as :class:`InverseMap`.
    """
    finer = [min(2 * count - 1, MAX_POINTS) for count in (grid.rows, grid.columns)]
    return Grid.from_map(InverseMap(grid), rows or finer[0], columns or finer[1])


def _newton_step(forward: ContinuedLattice, target: Float64, error: Float64) -> Float64:
    """(n, 2) solutions of J step = error with J the Jacobian in the cell of each target; J^T where J is singular."""
    jacobian = forward.jacobian(target)
    a, b, c, d = jacobian[:, 0, 0], jacobian[:, 0, 1], jacobian[:, 1, 0], jacobian[:, 1, 1]
    determinant = a * d - b * c
    floor = 1e-3 * np.maximum(np.abs(a * d) + np.abs(b * c), 1e-9)
    determinant = np.where(np.abs(determinant) < floor, np.copysign(floor, determinant), determinant)
    x = (d * error[:, 0] - b * error[:, 1]) / determinant
    y = (a * error[:, 1] - c * error[:, 0]) / determinant
    step = np.stack([x, y], axis=1)
    # a step past the next few cells says more of one cell's Jacobian than of the map
    return np.asarray(step / np.maximum(1, np.abs(step).max(axis=1, keepdims=True) / 0.25))


def _starts(forward: ContinuedLattice) -> Float64:
    """(_BINS, _BINS, 2) float64 target points, one per bin of source points over [-_BINNED, _BINNED]^2.

    Where several targets show the same source (the continuation may fold far out) the one nearest to the middle wins;
    bins that none shows take over the mean of their neighbours, ring after ring.
    """
    target = target_lattice(_SEARCH_POINTS, _SEARCH_POINTS, INVERSION_EXTENT)
    source = forward(target)
    orientation = cell_orientations(source)
    inside = np.asarray((np.abs(target) <= 1).all(axis=-1))
    near = inside[:-1, :-1] & inside[1:, 1:]
    sign = np.sign(np.median(orientation[near]))
    kept = np.pad((orientation * sign > 0).all(axis=-1), 1, constant_values=True)
    usable = kept[:-1, :-1] & kept[:-1, 1:] & kept[1:, :-1] & kept[1:, 1:]
    usable &= (np.abs(source) < _BINNED).all(axis=-1)
    if not usable.any():
        raise InvalidGrid("No part of the target shows the source.")
    bins = ((source[usable] / _BINNED + 1) / 2 * _BINS).astype(np.intp)
    points = target[usable]
    outermost_first = np.argsort(-(points**2).sum(axis=-1), kind="stable")
    starts = np.zeros((_BINS, _BINS, 2))
    known = np.zeros((_BINS, _BINS), dtype=bool)
    column, row = bins[outermost_first].T
    starts[row, column] = points[outermost_first]  # the last assignment of a bin stays
    known[row, column] = True
    while not known.all():
        starts, known = _filled(starts, known)
    return starts


def _filled(starts: Float64, known: npt.NDArray[np.bool_]) -> tuple[Float64, npt.NDArray[np.bool_]]:
    weight = np.pad(known.astype(np.float64), 1)
    value = np.pad(starts * known[..., None], ((1, 1), (1, 1), (0, 0)))
    total, count = np.zeros_like(starts), np.zeros(known.shape)
    for dy in range(3):
        for dx in range(3):
            total += value[dy : dy + _BINS, dx : dx + _BINS]
            count += weight[dy : dy + _BINS, dx : dx + _BINS]
    mean = total / np.maximum(count, 1)[..., None]
    return np.where(known[..., None], starts, mean), known | (count > 0)
