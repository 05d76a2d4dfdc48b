"""Strength and fit: which part of the corrected plane the target frame shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unbend_service.domain.errors import InvalidGrid, InvalidOption
from unbend_service.domain.grid import MAX_SOURCE, Float32, Grid, folded_share
from unbend_service.domain.maps import Float64, target_lattice
from unbend_service.domain.windows import Window, WindowSearch, within

#: Excess over 1 that is rounding, not a gap: 0.04 px in a picture of 8192.
_ROUNDING = 1e-5
#: A window smaller than this, in half picture widths, shows no picture.
_SMALLEST_WINDOW = 1e-3


@dataclass(frozen=True, slots=True)
class Fit:
    """``keep``, or a number from 0 (``crop``: no invalid pixel) to 1 (``full``: every source pixel).

    Attributes:
        zoom_out: None for ``keep``.
    """

    zoom_out: float | None

    @classmethod
    def parse(cls, text: str) -> Fit:
        """Raises InvalidOption for anything but keep, crop, full or a number 0..1."""
        named = {"keep": KEEP, "crop": CROP, "full": FULL}.get(text)
        if named is not None:
            return named
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not 0 <= value <= 1:
            raise InvalidOption(f"fit={text!r} is not known.", allowed="keep, crop, full, or a number 0..1")
        return cls(value)

    def __str__(self) -> str:
        return {None: "keep", 0.0: "crop", 1.0: "full"}.get(self.zoom_out) or f"{self.zoom_out:g}"


KEEP = Fit(None)
CROP = Fit(0.0)
FULL = Fit(1.0)


def check_strength(strength: float) -> float:
    """Raises InvalidOption unless 0 <= strength <= 1."""
    if not 0 <= strength <= 1:
        raise InvalidOption(f"strength={strength!r} is out of range.", allowed="0..1")
    return strength


def with_strength(grid: Grid, strength: float) -> Grid:
    """Blend with the identity: source = (1 - strength) target + strength grid(target)."""
    check_strength(strength)
    if strength == 1:
        return grid
    target = target_lattice(grid.rows, grid.columns)
    return Grid((target + strength * (grid.source - target)).astype(np.float32))


def with_fit(grid: Grid, fit: Fit) -> Grid:
    """The grid of the target frame that ``fit`` asks for, of the same number of points.

    ``crop``: every point of the result lies in [-1, 1]^2, and so does every point interpolated between them.
    ``full`` and numbers: where the grid's continuation folds, as much is shown as does not.

    Raises:
        InvalidGrid: no part of the target shows the source.
    """
    if fit.zoom_out is None:
        return grid
    lattice = target_lattice(grid.rows, grid.columns)
    if np.array_equal(grid.source, lattice.astype(np.float32)):
        return grid
    search = WindowSearch(grid)
    crop = search.crop()
    cropped = _without_gaps(grid, crop, lattice)
    if fit.zoom_out == 0:
        return cropped
    full = search.full()
    share = fit.zoom_out
    while share > 0.01:
        fitted = _shown(grid, crop.towards(full, share), lattice)
        if folded_share(fitted) == 0:
            return Grid(fitted)
        share *= 0.9
    return cropped


def _shown(grid: Grid, window: Window, lattice: Float64) -> Float32:
    """Source points of a window; those just outside by rounding are put on the border, far ones are held at a bound."""
    source = grid(window.points(lattice))
    source = np.where((np.abs(source) > 1) & (np.abs(source) < 1 + _ROUNDING), np.sign(source), source)
    return np.clip(source, -MAX_SOURCE, MAX_SOURCE).astype(np.float32)


def _without_gaps(grid: Grid, window: Window, lattice: Float64) -> Grid:
    """Shrinks the window until all points of its lattice are valid: between them the rendered lattice is linear."""
    half = window.half
    for _ in range(200):
        source = _shown(grid, Window(window.x, window.y, half), lattice)
        if half > _SMALLEST_WINDOW and within(source).all() and folded_share(source) == 0:
            return Grid(source)
        half *= 0.99
    raise InvalidGrid("No part of the target shows the source without a gap.")
