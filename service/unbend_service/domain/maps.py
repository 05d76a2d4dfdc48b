"""Backward maps: functions from target points to source points, both in centred coordinates."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]

#: (..., 2) float64 centred target points -> (..., 2) float64 centred source points.
BackwardMap = Callable[[Float64], Float64]


def target_lattice(rows: int, columns: int, extent: float = 1.0) -> Float64:
    """(rows, columns, 2) float64 points (s, t), evenly spaced over [-extent, extent] inclusive."""
    s, t = np.meshgrid(np.linspace(-extent, extent, columns), np.linspace(-extent, extent, rows))
    return np.stack([s, t], axis=-1)


def pixel_centres(length_px: int) -> Float64:
    """(length_px,) float64 centred coordinates of the pixel centres of one axis: 2 (i + 0.5) / n - 1."""
    return (2 * np.arange(length_px, dtype=np.float64) + 1) / length_px - 1
