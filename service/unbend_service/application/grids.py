"""The grid library: grids that were estimated, uploaded, or drawn by hand."""

from __future__ import annotations

from typing import Any

from unbend_service.application.blocking import BlockingWork
from unbend_service.application.ports import GridStore
from unbend_service.domain.decision import spin_grid
from unbend_service.domain.errors import GridConflict
from unbend_service.domain.grid import Grid
from unbend_service.domain.guides import Guides
from unbend_service.domain.records import Correct, GridRecord


class GridLibrary:
    """Stores, returns and forgets grids."""

    def __init__(self, store: GridStore, blocking: BlockingWork, *, grid_points: int) -> None:
        self._store = store
        self._blocking = blocking
        self._grid_points = grid_points

    async def get(self, grid_id: str) -> GridRecord:
        """Raises GridNotFound."""
        return await self._store.get(grid_id)

    async def put(self, value: Any, expected_id: str | None = None) -> GridRecord:
        """Stores a record in its JSON form, {grid: ..., ...} or {guides: ...} alone.

        Raises:
            InvalidGrid, InvalidGuides, FoldedGrid: the content is not usable.
            GridConflict: ``expected_id`` is not the id of the content.
        """
        return await self.put_record(await self._blocking.run("grid", self._record, value), expected_id)

    async def put_guides(self, guides: Guides, expected_id: str | None = None) -> GridRecord:
        """Stores the grid that ``guides`` span, all of their map; raises as :meth:`put`."""
        return await self.put_record(await self._blocking.run("grid", self._spun, guides), expected_id)

    async def put_grid(self, grid: Grid, expected_id: str | None = None) -> GridRecord:
        """Stores a lattice; raises as :meth:`put`."""
        return await self.put_record(GridRecord(grid), expected_id)

    async def put_record(self, record: GridRecord, expected_id: str | None = None) -> GridRecord:
        """Stores a record; raises as :meth:`put`."""
        await self._blocking.run("grid", record.grid.check_unfolded)
        if expected_id is not None and expected_id != record.id:
            raise GridConflict(
                f"The content has the id {record.id}, not {expected_id}.",
                allowed="the id of the content; POST /v1/grids computes it",
            )
        await self._store.put(record)
        return record

    async def delete(self, grid_id: str) -> None:
        """Raises GridNotFound."""
        await self._store.delete(grid_id)

    def _record(self, value: Any) -> GridRecord:
        if isinstance(value, dict) and value.get("grid") is None and value.get("guides") is not None:
            return self._spun(Guides.from_dict(value["guides"]))
        return GridRecord.from_dict(value)

    def _spun(self, guides: Guides) -> GridRecord:
        return GridRecord(spin_grid(guides, Correct.ALL, self._grid_points), guides)
