"""The lattice of a grid as triangles over the target."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from unbend_service.domain.grid import MAX_POINTS, Grid
from unbend_service.domain.maps import Float64, target_lattice

_LEAST_CELLS = 64
#: How far a triangle may be from the bilinear cell, in half picture widths: 0.05 px at 1920.
_TOLERANCE = 5e-5
#: The mesh goes on to here beyond the right and the lower edge, so that chroma samples on that very edge are covered.
_OVERSCAN = 2.0


def mesh_vertices(grid: Grid) -> npt.NDArray[np.float32]:
    """Vertices of the mesh of ``grid``.

    A grid is bilinear in its cells and triangles are not, so cells are divided until the difference does not matter.

    Returns:
        (rows, columns, 4) float32: target (s, t), and source minus target, both centred. The last row and column lie
        outside the target.
    """
    cross = np.diff(np.diff(grid.source.astype(np.float64), axis=0), axis=1)
    bend = math.ceil(math.sqrt(float(np.abs(cross).max()) / 4 / _TOLERANCE))
    rows, columns = (_divided(points, bend) for points in (grid.rows, grid.columns))
    target = target_lattice(rows, columns)
    source = grid.source if (rows, columns) == (grid.rows, grid.columns) else grid(target)
    vertices = np.concatenate([target, source - target], axis=-1)
    vertices = _overscanned(vertices)
    return np.ascontiguousarray(_overscanned(vertices.transpose(1, 0, 2)).transpose(1, 0, 2), dtype=np.float32)


def mesh_triangles(rows: int, columns: int) -> npt.NDArray[np.uint32]:
    """(2 (rows - 1) (columns - 1), 3) uint32 indices; every cell is cut along the same diagonal."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).astype(np.uint32).reshape(-1, 1)
    offsets = np.array([[0, 1, columns], [1, columns + 1, columns]], dtype=np.uint32)
    return (corner[:, :, None] + offsets).reshape(-1, 3)


def _divided(points: int, bend: int) -> int:
    """Points of an axis whose cells are divided into ``bend`` parts, or into so many that there are _LEAST_CELLS."""
    cells = points - 1
    parts = max(bend, math.ceil(_LEAST_CELLS / cells))
    return cells * max(1, min(parts, (MAX_POINTS - 1) // cells)) + 1


def _overscanned(vertices: Float64) -> Float64:
    """One more row, on the straight line through the last two, at _OVERSCAN."""
    step = 2 / (len(vertices) - 1)
    last = vertices[-1] + (vertices[-1] - vertices[-2]) * (_OVERSCAN - 1) / step
    return np.concatenate([vertices, last[None]])
