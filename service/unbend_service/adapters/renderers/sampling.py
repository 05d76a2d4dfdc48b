"""Where the samples of a plane lie in the picture, and where a grid sends them.

Positions are counted in samples of the plane, sample centres at whole numbers (the frame of cv2.remap). A plane of half
resolution is placed through the pixels of the luma plane: its sample ``i`` covers the pixels ``2i`` and ``2i + 1`` and
lies between them, at pixel position ``2i + 0.5``. For an odd size the last chroma sample therefore lies on the very
edge of the picture, at centred 1, and luma and chroma agree about every point.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from unbend_service.domain.frames import Frame, Plane
from unbend_service.domain.grid import Grid
from unbend_service.domain.maps import Float64, target_lattice

Float32 = npt.NDArray[np.float32]

#: A source point so little outside the picture still counts as inside: float32 cannot place the edge any better.
EDGE_TOLERANCE_PX = 1 / 64
#: Maps are made and used in strips of rows of at most so many samples, which bounds the memory of very large frames.
STRIP_SAMPLES = 1 << 22


@dataclass(frozen=True, slots=True)
class PlaneSampling:
    """Where the samples of one plane lie.

    Attributes:
        width, height: samples.
        step_px: pixels of the picture per sample on both axes, 1 or 2.
        frame_width_px, frame_height_px: the picture.
    """

    width: int
    height: int
    step_px: int
    frame_width_px: int
    frame_height_px: int

    @classmethod
    def of(cls, frame: Frame, plane: Plane) -> PlaneSampling:
        return cls(plane.width, plane.height, 2 if plane.chroma else 1, frame.width, frame.height)

    @property
    def extent(self) -> Float64:
        """(2,) float64, width and height of the picture in samples; not whole for chroma of an odd size."""
        return np.array([self.frame_width_px, self.frame_height_px], dtype=np.float64) / self.step_px

    def displacement(self, grid: Grid) -> Float32:
        """(rows, columns, 2) float32: source minus target position of each lattice point, in samples.

        The difference is kept instead of the position because it is small where float32 would be coarse, and zero
        for the identity.
        """
        target = target_lattice(grid.rows, grid.columns)
        return np.asarray((grid.source - target) / 2 * self.extent, dtype=np.float32)

    @property
    def valid_low(self) -> float:
        """Least position, on both axes, that counts as inside the source."""
        return -0.5 - EDGE_TOLERANCE_PX / self.step_px

    @property
    def valid_high(self) -> tuple[float, float]:
        """Greatest (x, y) position that counts as inside the source."""
        width, height = self.extent - 0.5 + EDGE_TOLERANCE_PX / self.step_px
        return float(width), float(height)

    def shows_only_source(self, grid: Grid) -> bool:
        """Whether no target sample of the plane needs the border colour, whatever its position."""
        low, high = grid.source.min(axis=(0, 1)), grid.source.max(axis=(0, 1))
        tolerance = 2 * EDGE_TOLERANCE_PX / self.step_px / self.extent
        return bool((low >= -1 - tolerance).all() and (high <= 1 + tolerance).all())

    def strips(self) -> Iterator[tuple[int, int]]:
        """Ranges of rows (first, end) that cover the plane."""
        rows = max(1, STRIP_SAMPLES // self.width)
        for first in range(0, self.height, rows):
            yield first, min(first + rows, self.height)

    def source_maps(self, grid: Grid, first: int, end: int) -> tuple[Float32, Float32]:
        """Source positions of the target samples of the rows ``first`` to ``end``.

        Returns:
            (end - first, width) float32 x and y, in samples of this plane, bilinear in each cell of the lattice.
        """
        column, u = self._cells(np.arange(self.width), self.frame_width_px, grid.columns)
        row, v = self._cells(np.arange(first, end), self.frame_height_px, grid.rows)
        lattice = self.displacement(grid)[row[0] : row[-1] + 2]
        row -= row[0]
        bands = np.append(np.flatnonzero(np.diff(row, prepend=-1)), len(row))
        # a row of the map is v * (bottom - top) + top + own: a product of matrices, which writes it in a single pass
        weights = np.ones((end - first, 3), dtype=np.float32)
        weights[:, 0] = v
        terms = np.ones((3, self.width), dtype=np.float32)
        maps = []
        for axis, own in enumerate((np.arange(self.width), np.arange(first, end))):
            points = lattice[..., axis]
            across = points[:, column] * (1 - u) + points[:, column + 1] * u
            (terms[2], weights[:, 2]) = (own, 1) if axis == 0 else (1, own)
            dense = np.empty((end - first, self.width), dtype=np.float32)
            for start, stop in pairwise(bands):  # each lies between two rows of the lattice
                top, bottom = across[row[start]], across[row[start] + 1]
                np.subtract(bottom, top, out=terms[0])
                terms[1] = top
                np.matmul(weights[start:stop], terms, out=dense[start:stop])
            maps.append(dense)
        return maps[0], maps[1]

    def _cells(self, sample: npt.NDArray[np.intp], length_px: int, points: int) -> tuple[npt.NDArray[np.intp], Float32]:
        """Lattice cell of each sample of one axis, and how far into the cell it lies (0..1, float32)."""
        position = (sample + 0.5) * self.step_px / length_px * (points - 1)
        cell = np.clip(position.astype(np.intp), 0, points - 2)
        return cell, (position - cell).astype(np.float32)
