"""Grid: the lattice that a renderer samples, and what may be asked of it."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from unbend_service.domain.continuation import ContinuedLattice
from unbend_service.domain.errors import FoldedGrid, InvalidGrid
from unbend_service.domain.maps import BackwardMap, Float64, target_lattice

Float32 = npt.NDArray[np.float32]

DEFAULT_POINTS = 65
MAX_POINTS = 1025
#: Source points further out than this are refused: no lens, only a broken file, puts them there.
MAX_SOURCE = 16.0


@dataclass(frozen=True, eq=False)
class Grid:
    """A lattice of source points for a regular lattice over the target; as a callable, its backward map.

    Attributes:
        source: (rows, columns, 2) float32, read-only, row-major. ``source[r, c] = (x, y)`` is the centred source point
            of the centred target point (2 c / (columns - 1) - 1, 2 r / (rows - 1) - 1).

    Raises:
        InvalidGrid: wrong shape or size, not finite, or further out than MAX_SOURCE.
    """

    source: Float32

    def __post_init__(self) -> None:
        with np.errstate(over="ignore"):
            source = np.array(self.source, dtype=np.float32, order="C")
        if source.ndim != 3 or source.shape[2] != 2 or not all(2 <= n <= MAX_POINTS for n in source.shape[:2]):
            raise InvalidGrid(
                f"A grid of shape {source.shape}.",
                allowed=f"(rows, columns, 2), 2 to {MAX_POINTS} of each",
            )
        if not np.isfinite(source).all():
            raise InvalidGrid("The grid has a number that is not finite.", allowed="finite numbers")
        if np.abs(source).max() > MAX_SOURCE:
            raise InvalidGrid("The grid has a source point too far out.", allowed=f"-{MAX_SOURCE:g} to {MAX_SOURCE:g}")
        source += np.float32(0)  # -0.0 becomes 0.0, so that equal grids have equal ids
        source.flags.writeable = False
        object.__setattr__(self, "source", source)

    @classmethod
    def identity(cls, rows: int = DEFAULT_POINTS, columns: int = DEFAULT_POINTS) -> Grid:
        """The grid that changes nothing."""
        return cls(target_lattice(rows, columns).astype(np.float32))

    @classmethod
    def from_map(cls, backward: BackwardMap, rows: int = DEFAULT_POINTS, columns: int = DEFAULT_POINTS) -> Grid:
        """Samples ``backward`` at the lattice points."""
        return cls(backward(target_lattice(rows, columns)).astype(np.float32))

    @property
    def rows(self) -> int:
        return int(self.source.shape[0])

    @property
    def columns(self) -> int:
        return int(self.source.shape[1])

    @cached_property
    def id(self) -> str:
        """Content-derived: SHA-256 over the shape and the little-endian float32 points, 128 bits of it in hex."""
        digest = hashlib.sha256(f"unbend grid 1 {self.rows} {self.columns}\n".encode())
        digest.update(self.source.astype("<f4").tobytes())
        return "g" + digest.hexdigest()[:32]

    def __call__(self, target: Float64) -> Float64:
        """Bilinear in each cell; outside [-1, 1] the lattice is continued, see :mod:`.continuation`.

        Args:
            target: (..., 2) float64 centred target points.

        Returns:
            (..., 2) float64 centred source points.
        """
        target = np.asarray(target, dtype=np.float64)
        return self.continued(float(np.abs(target).max(initial=0)))(target)

    def continued(self, extent: float) -> ContinuedLattice:
        """The backward map of this grid with its continuation over [-extent, extent] worked out once."""
        return ContinuedLattice.of(self.source, extent)

    @cached_property
    def displacement(self) -> float:
        """Mean length of source - target over the lattice, in half picture widths (1 px at width W is 2 / W)."""
        offset = self.source - target_lattice(self.rows, self.columns)
        return float(np.hypot(offset[..., 0], offset[..., 1]).mean())

    @cached_property
    def is_unfolded(self) -> bool:
        """Whether the Jacobian keeps its sign in every cell that shows some of the source."""
        return folded_share(self.source) == 0

    def check_unfolded(self) -> None:
        """Raises FoldedGrid unless the grid is unfolded."""
        if not self.is_unfolded:
            raise FoldedGrid(
                "The grid folds over itself inside the picture.",
                allowed="a lattice whose cells all keep the same orientation",
            )

    def to_dict(self) -> dict[str, Any]:
        """The ``grid`` object of the API: {rows, columns, source: [[x, y], ...]}; the round trip is exact."""
        points = self.source.reshape(-1, 2).astype(np.float64).tolist()
        return {"rows": self.rows, "columns": self.columns, "source": points}

    @classmethod
    def from_dict(cls, value: Any) -> Grid:
        """Inverse of :meth:`to_dict`; raises InvalidGrid for anything else."""
        if not isinstance(value, dict) or not {"rows", "columns", "source"} <= value.keys():
            raise InvalidGrid("A grid must be an object with rows, columns and source.")
        rows, columns, points = value["rows"], value["columns"], value["source"]
        if type(rows) is not int or type(columns) is not int or not isinstance(points, list):
            raise InvalidGrid("rows and columns must be integers and source a list of [x, y].")
        if not (2 <= rows <= MAX_POINTS and 2 <= columns <= MAX_POINTS) or len(points) != rows * columns:
            raise InvalidGrid(
                f"{len(points)} source points for {rows} rows and {columns} columns.",
                allowed=f"rows x columns points, 2 to {MAX_POINTS} of each",
            )
        try:
            array = np.array(points)
        except (TypeError, ValueError, OverflowError) as error:
            raise InvalidGrid("source must be a list of [x, y] numbers.") from error
        if array.shape != (rows * columns, 2) or array.dtype.kind not in "fiu":
            raise InvalidGrid("source must be a list of [x, y] numbers.")
        with np.errstate(over="ignore"):  # an overflow becomes infinite and is refused as such
            return cls(array.reshape(rows, columns, 2).astype(np.float32))


def cell_orientations(source: npt.NDArray[Any]) -> Float64:
    """(rows - 1, columns - 1, 4) signed areas of the corner triangles of each cell, of a (rows, columns, 2) lattice."""
    return np.stack(_orientations(source), axis=-1)


def _orientations(source: npt.NDArray[Any]) -> list[Float64]:
    """What `cell_orientations` stacks: at each corner, the cross product of the sides that meet there."""
    x, y = (np.asarray(source[..., axis], dtype=np.float64) for axis in (0, 1))
    (right_x, down_x), (right_y, down_y) = ((np.diff(axis, axis=1), np.diff(axis, axis=0)) for axis in (x, y))
    above_x, below_x, above_y, below_y = right_x[:-1], right_x[1:], right_y[:-1], right_y[1:]
    left_x, beside_x, left_y, beside_y = down_x[:, :-1], down_x[:, 1:], down_y[:, :-1], down_y[:, 1:]
    return [
        np.asarray(across_x * along_y - across_y * along_x)
        for across_x, across_y, along_x, along_y in (
            (above_x, above_y, left_x, left_y),
            (above_x, above_y, beside_x, beside_y),
            (below_x, below_y, beside_x, beside_y),
            (below_x, below_y, left_x, left_y),
        )
    ]


def folded_share(source: npt.NDArray[Any]) -> float:
    """Share of the cells that show some of the source and do not keep the orientation of the others.

    A lattice that shows nothing of the source counts as folded everywhere.
    """
    visible = _visible(source[..., 0]) & _visible(source[..., 1])
    if not visible.any():
        return 1.0
    orientation = np.stack([corner[visible] for corner in _orientations(source)])
    if orientation.min() > 0 or orientation.max() < 0:
        return 0.0
    sign = 1.0 if np.median(orientation) > 0 else -1.0
    return float((orientation * sign <= 0).any(axis=0).mean())


def _visible(axis: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:
    """(rows - 1, columns - 1) whether some of [-1, 1] lies between the corners of a cell."""
    low, high = np.minimum(axis[:-1], axis[1:]), np.maximum(axis[:-1], axis[1:])
    return np.asarray((np.minimum(low[:, :-1], low[:, 1:]) <= 1) & (np.maximum(high[:, :-1], high[:, 1:]) >= -1))
