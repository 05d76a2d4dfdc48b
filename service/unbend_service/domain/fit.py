"""Strength and fit: which part of the corrected plane the target frame shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from unbend_service.domain.errors import InvalidGrid, InvalidOption
from unbend_service.domain.grid import Grid, cell_orientations
from unbend_service.domain.maps import BackwardMap, Float64, target_lattice

#: How far beyond the estimated frame the search for a window goes, in half picture widths.
_SEARCH_EXTENT = 2.0
_SEARCH_POINTS = 257


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


@dataclass(frozen=True, slots=True)
class Window:
    """An upright part of the target plane with the aspect of the picture: a square in centred coordinates."""

    x: float
    y: float
    half: float

    def points(self, lattice: Float64) -> Float64:
        """Maps (..., 2) points of [-1, 1]^2 into the window."""
        return np.asarray(lattice * self.half + np.array([self.x, self.y]))


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

    Raises:
        InvalidGrid: no part of the target shows the source.
    """
    if fit.zoom_out is None:
        return grid
    lattice = target_lattice(grid.rows, grid.columns)
    crop = _crop_window(grid, lattice)
    if fit.zoom_out == 0:
        return _shrunk_until_valid(grid, crop, lattice)
    full = _full_window(grid)
    share = fit.zoom_out
    blended = Window(
        crop.x + share * (full.x - crop.x),
        crop.y + share * (full.y - crop.y),
        crop.half + share * (full.half - crop.half),
    )
    return Grid(grid(blended.points(lattice)).astype(np.float32))


def _valid(source: Float64) -> npt.NDArray[np.bool_]:
    return np.asarray((np.abs(source) <= 1).all(axis=-1))


def _search_area(backward: BackwardMap) -> tuple[Float64, npt.NDArray[np.bool_]]:
    """Lattice points of the search area and whether each shows the source, unfolded."""
    points = target_lattice(_SEARCH_POINTS, _SEARCH_POINTS, _SEARCH_EXTENT)
    source = backward(points)
    orientation = cell_orientations(source)
    middle = orientation[_SEARCH_POINTS // 4 : -_SEARCH_POINTS // 4, _SEARCH_POINTS // 4 : -_SEARCH_POINTS // 4]
    sign = 1.0 if np.median(middle) > 0 else -1.0
    kept = (orientation * sign > 0).all(axis=-1)
    shown = _valid(source)
    shown[:-1, :-1] &= kept
    shown[1:, 1:] &= kept
    if not shown.any():
        raise InvalidGrid("No part of the target shows the source.")
    return points, shown


def _crop_window(grid: Grid, lattice: Float64) -> Window:
    """The largest window without invalid points, found on the search lattice and then made larger by small steps."""
    points, shown = _search_area(grid)
    sums = np.pad(np.cumsum(np.cumsum(shown, axis=0), axis=1), ((1, 0), (1, 0)))

    def places(size: int) -> npt.NDArray[np.bool_]:
        total = sums[size:, size:] - sums[:-size, size:] - sums[size:, :-size] + sums[:-size, :-size]
        return np.asarray(total == size * size)

    low, high = 1, _SEARCH_POINTS
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if places(middle).any() else (low, middle - 1)
    rows, columns = np.nonzero(places(low))
    spacing = 2 * _SEARCH_EXTENT / (_SEARCH_POINTS - 1)
    half = (low - 1) * spacing / 2
    centres = points[rows, columns] + half
    best = centres[np.argmin(np.hypot(centres[:, 0], centres[:, 1]))]
    return _grown(grid, Window(float(best[0]), float(best[1]), half), lattice, spacing)


def _grown(grid: Grid, window: Window, lattice: Float64, spacing: float) -> Window:
    """Pattern search over the centre; at each centre the largest half extent is found by bisection.

    Only the rim is looked at: where the map does not fold, the picture of a window lies inside that of its rim.
    """
    rim = np.concatenate([lattice[0], lattice[-1], lattice[:, 0], lattice[:, -1]])

    def largest(x: float, y: float, at_least: float) -> float:
        if not _valid(grid(Window(x, y, at_least).points(rim))).all():
            return 0.0
        low, high = at_least, at_least + 2 * spacing
        for _ in range(9):
            middle = (low + high) / 2
            low, high = (middle, high) if _valid(grid(Window(x, y, middle).points(rim))).all() else (low, middle)
        return low

    x, y = window.x, window.y
    half = max(largest(x, y, max(window.half - spacing, 0.0)), 1e-3)
    step = spacing
    for _ in range(40):
        if step < spacing / 16:
            break
        candidates = [(x + dx * step, y + dy * step) for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1))]
        tried = [(largest(cx, cy, half + 1e-5), cx, cy) for cx, cy in candidates]
        better = max(tried)
        if better[0] > half:
            half, x, y = better
        else:
            step /= 2
    return Window(x, y, half)


def _shrunk_until_valid(grid: Grid, window: Window, lattice: Float64) -> Grid:
    """The rendered lattice is piecewise linear, so it shows no invalid pixel once all of its points are valid."""
    half = window.half
    for _ in range(200):
        fitted = Grid(grid(Window(window.x, window.y, half).points(lattice)).astype(np.float32))
        if _valid(fitted.source).all():
            return fitted
        half *= 0.99
    raise InvalidGrid("No part of the target shows the source without a gap.")


def _full_window(grid: Grid) -> Window:
    points, shown = _search_area(grid)
    inside = points[shown]
    low, high = inside.min(axis=0), inside.max(axis=0)
    spacing = 2 * _SEARCH_EXTENT / (_SEARCH_POINTS - 1)
    centre = (low + high) / 2
    return Window(float(centre[0]), float(centre[1]), float((high - low).max() / 2 + spacing / 2))
