"""Windows: upright parts of the target plane, and the search for the largest and for the all-embracing one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from unbend_service.domain.errors import InvalidGrid
from unbend_service.domain.grid import Grid, cell_orientations
from unbend_service.domain.maps import Float64, target_lattice

#: How far beyond the estimated frame windows are looked for, in half picture widths.
SEARCH_EXTENT = 2.0
_SEARCH_POINTS = 129
_SPACING = 2 * SEARCH_EXTENT / (_SEARCH_POINTS - 1)
_MOST_RIM_POINTS = 65
_BORDER_POINTS = 65
_STEP = 1e-3


@dataclass(frozen=True, slots=True)
class Window:
    """An upright part of the target plane with the aspect of the picture: a square in centred coordinates."""

    x: float
    y: float
    half: float

    def points(self, lattice: Float64) -> Float64:
        """Maps (..., 2) points of [-1, 1]^2 into the window."""
        return np.asarray(lattice * self.half + np.array([self.x, self.y]))

    def towards(self, other: Window, share: float) -> Window:
        """The window ``share`` (0..1) of the way to ``other``."""
        return Window(
            self.x + share * (other.x - self.x),
            self.y + share * (other.y - self.y),
            self.half + share * (other.half - self.half),
        )


class WindowSearch:
    """Looks for windows of one grid.

    The search plane is sampled once; a sample is *shown* when its source lies in the picture and the cells around it
    keep the orientation of the map, so that no window reaches into a part where the continuation folds back. Of the
    shown samples only those count that hang together with the one nearest to the middle.

    Raises:
        InvalidGrid: no part of the target shows the source.
    """

    def __init__(self, grid: Grid) -> None:
        self._backward = grid.continued(SEARCH_EXTENT)
        self._shape = (grid.rows, grid.columns)
        self._points = target_lattice(_SEARCH_POINTS, _SEARCH_POINTS, SEARCH_EXTENT)
        source = self._backward(self._points)
        orientation = cell_orientations(source)
        visible = within(source)
        touching = visible[:-1, :-1] | visible[:-1, 1:] | visible[1:, 1:] | visible[1:, :-1]
        if not touching.any():
            raise InvalidGrid("No part of the target shows the source.")
        self._sign = 1.0 if np.median(orientation[touching]) > 0 else -1.0
        kept = np.pad((orientation * self._sign > 0).all(axis=-1), 1, constant_values=True)
        self._source = source
        shown = visible & kept[:-1, :-1] & kept[:-1, 1:] & kept[1:, 1:] & kept[1:, :-1]
        if not shown.any():
            raise InvalidGrid("No part of the target shows the source.")
        middle = np.argmin(np.where(shown, (self._points**2).sum(axis=-1), np.inf))
        self._shown = _connected(shown, (int(middle // _SEARCH_POINTS), int(middle % _SEARCH_POINTS)))

    def crop(self) -> Window:
        """The largest window without an invalid point: of the samples first, then grown to the map itself.

        Only the rim of a window is looked at while it grows: where the map does not fold, the source of a window lies
        inside the closed curve that is the source of its rim, and the picture is convex. Whether it folds is asked
        at the end.
        """
        sums = np.pad(np.cumsum(np.cumsum(self._shown, axis=0), axis=1), ((1, 0), (1, 0)))

        def places(size: int) -> npt.NDArray[np.bool_]:
            total = sums[size:, size:] - sums[:-size, size:] - sums[size:, :-size] + sums[:-size, :-size]
            return np.asarray(total == size * size)

        low, high = 1, _SEARCH_POINTS
        while low < high:
            middle = (low + high + 1) // 2
            low, high = (middle, high) if places(middle).any() else (low, middle - 1)
        half = (low - 1) * _SPACING / 2
        centres = self._points[np.nonzero(places(low))] + half
        best = centres[np.argmin(np.hypot(*centres.T))]
        window = Window(float(best[0]), float(best[1]), half)
        grown = self._grown(window)
        candidates = (window.towards(grown, share) for share in (1.0, 0.75, 0.5, 0.25))
        return next((one for one in candidates if self._is_unfolded(one)), window)

    def full(self) -> Window:
        """The smallest window that holds every shown sample and the target of every point of the source's border.

        Border points whose target lies beyond the search plane, or where the map folds, are given up.
        """
        inside = np.concatenate([self._points[self._shown], self._border_targets()])
        low, high = inside.min(axis=0), inside.max(axis=0)
        centre = (low + high) / 2
        return Window(float(centre[0]), float(centre[1]), float((high - low).max() / 2))

    def _rim(self) -> Float64:
        """(n, 2) points of the boundary of [-1, 1]^2: those of the grid's lattice, thinned out if there are many."""
        rows, columns = (np.linspace(-1, 1, min(count, _MOST_RIM_POINTS)) for count in self._shape)
        across = [np.stack([columns, np.full_like(columns, side)], axis=-1) for side in (-1, 1)]
        return np.concatenate([*across, *(np.stack([np.full_like(rows, side), rows], axis=-1) for side in (-1, 1))])

    def _grown(self, window: Window) -> Window:
        """Sequential linear programming over centre and size (x, y, h), maximising h.

        The map is linearised at the rim; the step is bounded by a trust region and followed by a search for the
        largest valid window about the new centre, so that every iterate is valid.
        """
        rim = self._rim()
        window = self._largest(window, rim, window.half, window.half + 2 * _SPACING)
        trust = 4 * _SPACING
        for _ in range(16):
            at = window.points(rim)
            source = self._backward(at)
            by_x, by_y = self._slopes(at)
            by_half = by_x * rim[:, :1] + by_y * rim[:, 1:]
            slope = np.stack([by_x, by_y, by_half], axis=-1).reshape(-1, 3)
            normals = np.concatenate([slope, -slope, np.eye(3), -np.eye(3)])
            slack = np.concatenate([1 - source.ravel(), 1 + source.ravel(), np.full(6, trust)])
            x, y, half = _highest(normals, np.maximum(slack, 1e-7))
            moved = Window(window.x + float(x), window.y + float(y), window.half + float(half))
            better = self._largest(moved, rim, window.half, window.half + 1.5 * max(half, 1e-6))
            gain = better.half - window.half
            if gain > 0 and self._valid(better, rim):
                window = better
            if gain <= 0.3 * half:
                trust /= 4
            if trust < 1e-5 or half < 1e-6:
                break
        return window

    def _largest(self, window: Window, rim: Float64, low: float, high: float) -> Window:
        """The largest valid window about the centre of ``window`` between two half extents; the lower if none is."""
        for _ in range(3):
            halves = np.linspace(low, high, 17)[1:]
            at = rim * halves[:, None, None] + [window.x, window.y]
            bad = np.flatnonzero(~within(self._backward(at)).all(axis=-1))
            first = int(bad[0]) if len(bad) else len(halves)
            low, high = (halves[first - 1] if first else low), halves[min(first, len(halves) - 1)]
        return Window(window.x, window.y, float(low))

    def _is_unfolded(self, window: Window) -> bool:
        source = self._backward(window.points(target_lattice(*self._shape)))
        return bool((cell_orientations(source) * self._sign > 0).all())

    def _valid(self, window: Window, rim: Float64) -> bool:
        return bool(within(self._backward(window.points(rim))).all())

    def _slopes(self, at: Float64) -> tuple[Float64, Float64]:
        """Derivatives of the map by x and by y, each (n, 2)."""
        by_x, by_y = (
            (self._backward(at + _STEP * axis) - self._backward(at - _STEP * axis)) / (2 * _STEP) for axis in np.eye(2)
        )
        return by_x, by_y

    def _border_targets(self) -> Float64:
        """(n, 2) targets of points of the source's border, by Newton steps from the nearest shown sample."""
        side = np.linspace(-1, 1, _BORDER_POINTS)
        border = np.concatenate(
            [np.stack([side, np.full_like(side, end)], axis=-1) for end in (-1, 1)]
            + [np.stack([np.full_like(side, end), side], axis=-1) for end in (-1, 1)]
        )
        padded = np.pad(self._shown, 1)
        surrounded = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
        edge = self._shown & ~surrounded
        distance = ((border[:, None] - self._source[edge][None]) ** 2).sum(axis=-1)
        at = self._points[edge][np.argmin(distance, axis=1)]
        for _ in range(12):
            by_x, by_y = self._slopes(at)
            determinant = by_x[:, 0] * by_y[:, 1] - by_x[:, 1] * by_y[:, 0]
            safe = np.where(np.abs(determinant) < 1e-3, 1e-3 * self._sign, determinant)
            residual = self._backward(at) - border
            towards_x = (residual[:, 0] * by_y[:, 1] - residual[:, 1] * by_y[:, 0]) / safe
            towards_y = (residual[:, 1] * by_x[:, 0] - residual[:, 0] * by_x[:, 1]) / safe
            move = np.stack([towards_x, towards_y], axis=-1)
            at = np.clip(at - np.clip(move, -0.25, 0.25), -SEARCH_EXTENT, SEARCH_EXTENT)
        found = (np.abs(self._backward(at) - border).max(axis=1) < 1e-6) & (determinant * self._sign > 0)
        return np.asarray(at[found])


def within(source: npt.NDArray[np.floating]) -> npt.NDArray[np.bool_]:
    """(..., 2) centred source points -> (...) whether each lies in the picture."""
    return np.asarray((np.abs(source) <= 1).all(axis=-1))


def _connected(mask: npt.NDArray[np.bool_], seed: tuple[int, int]) -> npt.NDArray[np.bool_]:
    """The part of a (rows, columns) mask that hangs together, side by side, with the true sample ``seed``."""
    part = np.zeros_like(mask)
    part[seed] = True
    # Along each run of the mask one member makes all of the run members; runs are numbered by line and gap.
    numbered = []
    for axis in (0, 1):
        lines = np.expand_dims(np.arange(mask.shape[1 - axis]), axis) * (mask.shape[axis] + 1)
        numbered.append(np.cumsum(~mask, axis=axis) + lines)
    count = 0
    while (size := int(part.sum())) != count:
        count = size
        for runs in numbered:
            member = np.zeros(int(runs.max()) + 1, dtype=bool)
            member[runs[part]] = True
            part = mask & member[runs]
    return part


def _highest(normals: Float64, slack: Float64) -> Float64:
    """(3,) the z with the largest z[2] where ``normals @ z <= slack``, by a logarithmic barrier.

    Args:
        normals: (n, 3) float64.
        slack: (n,) float64, positive, so that 0 is feasible.
    """
    point = np.zeros(3)
    left = slack
    weight = 1.0 / slack.max()
    for _ in range(40):
        inverse = 1 / left
        gradient = normals.T @ inverse
        gradient[2] -= weight
        scaled = normals * inverse[:, None]
        curvature = scaled.T @ scaled
        curvature += 1e-12 * np.trace(curvature) * np.eye(3)  # a corner of the polytope makes it nearly singular
        step = -np.linalg.solve(curvature, gradient)
        change = normals @ step
        towards = change > 0
        length = min(1.0, 0.9 * float((left[towards] / change[towards]).min(initial=np.inf)))
        point = point + length * step
        left = slack - normals @ point
        if length > 0.5:
            weight *= 6
        if weight > 1e9:
            break
    return point
