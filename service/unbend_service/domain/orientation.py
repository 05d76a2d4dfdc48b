"""Orientation: how a picture is turned and mirrored before it is shown, as cameras say it in a few numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from unbend_service.domain.frames import Bytes, Frame
from unbend_service.domain.grid import Grid
from unbend_service.domain.maps import Float64

_ONE = 1 << 16


@dataclass(frozen=True, slots=True)
class Orientation:
    """One of the eight ways to lay a picture on its sides or its back.

    Attributes:
        matrix: (xx, xy, yx, yy), each -1, 0 or 1: centred coordinates (x, y) of the picture as it is stored are shown
            at (xx x + xy y, yx x + yy y), y down in both.
    """

    matrix: tuple[int, int, int, int] = (1, 0, 0, 1)

    @classmethod
    def of_display_matrix(cls, numbers: Sequence[int]) -> Orientation:
        """From the 3 x 3 display matrix of a video container, row-major, 16.16 fixed point (ISO/IEC 14496-12, 8.2.2).

        (x, y) is shown at (a x + c y, b x + d y) of the rows (a, b, u), (c, d, v). A matrix that turns by another angle
        than a quarter is no orientation; the picture then counts as upright.
        """
        a, b, c, d = (round(numbers[index] / _ONE) for index in (0, 1, 3, 4))
        upright_or_lying = abs(a) == abs(d) and abs(b) == abs(c) and {abs(a), abs(b)} == {0, 1}
        return cls((a, c, b, d)) if upright_or_lying else cls()

    @property
    def is_upright(self) -> bool:
        return self.matrix == (1, 0, 0, 1)

    @property
    def swaps_axes(self) -> bool:
        """Whether a wide picture is shown tall."""
        return self.matrix[0] == 0

    def shown(self, frame: Frame) -> Frame:
        """The picture as it is shown; same pixel format."""
        if self.is_upright:
            return frame
        width, height = (frame.height, frame.width) if self.swaps_axes else (frame.width, frame.height)
        data = np.concatenate([self._turned(plane).reshape(-1) for plane in frame.plane_arrays()])
        return Frame(frame.pixel_format, width, height, data)

    def stored(self, grid: Grid) -> Grid:
        """The grid that does to the stored picture what ``grid`` does to the shown one."""
        if self.is_upright:
            return grid
        rows, columns = (grid.columns, grid.rows) if self.swaps_axes else (grid.rows, grid.columns)
        xx, xy, yx, yy = self.matrix
        to_shown: Float64 = np.array([[xx, xy], [yx, yy]], dtype=np.float64)
        # the inverse of such a matrix is its transpose, so a row vector times the matrix itself goes back
        return Grid.from_map(lambda target: grid(target @ to_shown.T) @ to_shown, rows, columns)

    def _turned(self, plane: Bytes) -> Bytes:
        if self.swaps_axes:
            plane = plane.swapaxes(0, 1)
        xx, xy, yx, yy = self.matrix
        return plane[:: yx + yy, :: xx + xy]
