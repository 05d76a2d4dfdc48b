"""Grids as they are rendered: with strength and fit applied, computed once and kept."""

from __future__ import annotations

from collections import OrderedDict

from unbend_service.application.blocking import BlockingWork
from unbend_service.application.ports import Meter
from unbend_service.domain.fit import KEEP, Fit, check_strength, with_fit, with_strength
from unbend_service.domain.grid import Grid


def fitted(grid: Grid, fit: Fit, strength: float) -> Grid:
    """Strength first, then the fit of what is left of the correction.

    Raises:
        InvalidOption, InvalidGrid, FoldedGrid: see domain.fit.
    """
    blended = with_strength(grid, strength)
    blended.check_unfolded()
    return with_fit(blended, fit)


class FittedGrids:
    """Remembers the last grids that were fitted; the search for a crop window takes tens of milliseconds."""

    def __init__(self, blocking: BlockingWork, meter: Meter, entries: int = 256) -> None:
        self._blocking = blocking
        self._meter = meter
        self._entries = entries
        self._known: OrderedDict[tuple[str, Fit, float], Grid] = OrderedDict()

    async def get(self, grid: Grid, fit: Fit, strength: float) -> Grid:
        """As :func:`fitted`, off the event loop."""
        check_strength(strength)
        if fit == KEEP and strength == 1:
            return grid
        key = (grid.id, fit, strength)
        known = self._known.get(key)
        self._meter.grid_cache(known is not None)
        if known is not None:
            self._known.move_to_end(key)
            return known
        result = await self._blocking.run("grid", fitted, grid, fit, strength)
        self._known[key] = result
        while len(self._known) > self._entries:
            self._known.popitem(last=False)
        return result
