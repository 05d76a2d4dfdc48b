"""Grids that travel: written for other programs, and read from their files."""

from __future__ import annotations

from dataclasses import replace

from unbend_service.application.blocking import BlockingWork
from unbend_service.application.fitting import FittedGrids
from unbend_service.application.ports import GridFiles
from unbend_service.domain.dense_maps import inverse_pixel_maps, pixel_maps
from unbend_service.domain.errors import InvalidOption
from unbend_service.domain.exchange import (
    DenseMap,
    Direction,
    ExportedFile,
    ExportFormat,
    ExportOptions,
    ImportFormat,
    ImportOptions,
)
from unbend_service.domain.grid import MAX_POINTS, Grid
from unbend_service.domain.inversion import InverseMap, inverse
from unbend_service.domain.records import GridRecord


class Exchange:
    """Writes and reads grids off the event loop."""

    def __init__(self, files: GridFiles, grids: FittedGrids, blocking: BlockingWork) -> None:
        self._files = files
        self._grids = grids
        self._blocking = blocking

    async def export(self, record: GridRecord, kind: ExportFormat, options: ExportOptions) -> ExportedFile:
        """The file of a record.

        Raises:
            InvalidOption: no size, or one that is too large, for a format that has one.
            FoldedGrid, InvalidGrid: fit or inversion is impossible.
            Unavailable: the library that writes the format is not installed.
            QueueFull.
        """
        grid = await self._grids.get(record.grid, options.fit, options.strength)
        return await self._blocking.run("grid", self._written, record, grid, kind, options)

    async def read(self, body: bytes, kind: ImportFormat, options: ImportOptions) -> GridRecord:
        """The record that a file describes; not stored.

        Raises:
            InvalidGrid, FoldedGrid, InvalidGuides, InvalidOption: the content is not usable.
            Unavailable: the library that reads the format is not installed.
            QueueFull.
        """
        if not 2 <= options.points <= MAX_POINTS:
            raise InvalidOption(f"points={options.points} is out of range.", allowed=f"2..{MAX_POINTS}")
        return await self._blocking.run("grid", self._record, body, kind, options)

    def _written(self, record: GridRecord, grid: Grid, kind: ExportFormat, options: ExportOptions) -> ExportedFile:
        redistorts = options.direction is Direction.REDISTORT
        if kind is ExportFormat.JSON:
            if redistorts:
                return self._files.write_record(GridRecord(inverse(grid)))
            if grid is record.grid:
                return self._files.write_record(record)
            return self._files.write_record(replace(record, grid=grid, strength=record.strength * options.strength))
        if options.width is None or options.height is None:
            raise InvalidOption(f"A {kind} export has a size.", allowed="width and height in pixels")
        maps = inverse_pixel_maps if redistorts else pixel_maps
        return self._files.write_map(kind, DenseMap(*maps(grid, options.width, options.height)))

    def _record(self, body: bytes, kind: ImportFormat, options: ImportOptions) -> GridRecord:
        redistorts = options.direction is Direction.REDISTORT
        if kind is ImportFormat.JSON:
            record = self._files.read_record(body)
            return GridRecord(inverse(record.grid)) if redistorts else record
        # a map that is to be inverted is read finely, whatever becomes of it
        points = max(options.points, 257) if redistorts else options.points
        grid = Grid.from_map(self._files.read_map(kind, body), points, points)
        grid.check_unfolded()
        if not redistorts:
            return GridRecord(grid)
        return GridRecord(Grid.from_map(InverseMap(grid), options.points, options.points))
