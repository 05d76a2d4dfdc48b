"""Grids kept in one SQLite file: they survive restarts, and processes of one machine may share them."""

from __future__ import annotations

import asyncio
import dataclasses
import sqlite3
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np
import orjson

from unbend_service.domain.errors import GridNotFound, GridStoreUnavailable, InvalidInput
from unbend_service.domain.grid import Grid
from unbend_service.domain.records import GridRecord
from unbend_service.settings import Settings

R = TypeVar("R")

SCHEMA_VERSION = 1
_SCHEMA = """
CREATE TABLE grids (
    id TEXT PRIMARY KEY,
    rows INTEGER NOT NULL,
    columns INTEGER NOT NULL,
    source BLOB NOT NULL,      -- little-endian float32, (rows, columns, 2)
    provenance BLOB NOT NULL,  -- JSON of the record without its grid
    used_at REAL NOT NULL      -- seconds since the epoch
) WITHOUT ROWID;
CREATE INDEX grids_used_at ON grids (used_at);
CREATE TABLE streams (id TEXT PRIMARY KEY, grid_id TEXT NOT NULL, used_at REAL NOT NULL) WITHOUT ROWID;
CREATE INDEX streams_used_at ON streams (used_at);
"""
# Came later; a file of the same version may lack it, and a process that does not know it is not disturbed.
_CLAIMS = (
    "CREATE TABLE IF NOT EXISTS claims "
    "(stream_id TEXT PRIMARY KEY, token TEXT NOT NULL, expires_at REAL NOT NULL) WITHOUT ROWID"
)
_CAMERAS = (
    "CREATE TABLE IF NOT EXISTS cameras "
    "(id TEXT PRIMARY KEY, record BLOB NOT NULL, used_at REAL NOT NULL) WITHOUT ROWID"
)
_TABLES = ("grids", "streams", "cameras")
_BUSY_TIMEOUT_S = 5.0


class SqliteGridStore:
    """Port GridStore; one connection, used by one thread of its own.

    Args:
        settings: ``grid_store_path``; ``grid_store_entries`` bounds grids and stream bindings each,
            ``grid_store_ttl_s`` counts from the last use.
        clock: seconds since the epoch, for they outlive the process. By default it is set once, at start: a system
            clock that jumps afterwards makes no grid too old.

    Raises:
        GridStoreUnavailable: the file cannot be opened or is of another make. Every call raises it as well when the
            file or its disk fails.
    """

    def __init__(self, settings: Settings, clock: Callable[[], float] | None = None) -> None:
        self._path = settings.grid_store_path
        self._entries = settings.grid_store_entries
        self._ttl_s = settings.grid_store_ttl_s
        self._clock = clock or _steady_clock()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="unbend-grid-store")
        self._connection = self._open()

    async def put(self, record: GridRecord) -> None:
        await self._run(self._put, record)

    async def get(self, grid_id: str) -> GridRecord:
        """Raises GridNotFound."""
        return await self._run(self._get, grid_id, reading=True)

    async def delete(self, grid_id: str) -> None:
        """Raises GridNotFound."""
        await self._run(self._delete, grid_id)

    async def bind_stream(self, stream_id: str, grid_id: str, *, replace: bool = True) -> str:
        """The grid id that is bound now; without ``replace`` the one that was, while its grid is kept."""
        return await self._run(self._bind_stream, stream_id, grid_id, replace)

    async def stream_grid(self, stream_id: str) -> str | None:
        """The grid id that was bound; None if there is none, or its grid is gone."""
        return await self._run(self._stream_grid, stream_id, reading=True)

    async def claim_stream(self, stream_id: str, token: str, lease_s: float) -> bool:
        """Whether ``token`` holds the claim, for ``lease_s`` seconds from now."""
        return await self._run(self._claim_stream, stream_id, token, lease_s)

    async def release_stream(self, stream_id: str, token: str) -> None:
        await self._run(self._release_stream, stream_id, token)

    async def camera(self, name: str) -> bytes | None:
        return await self._run(self._camera, name, reading=True)

    async def swap_camera(self, name: str, known: bytes | None, value: bytes | None) -> bool:
        return await self._run(self._swap_camera, name, known, value)

    async def close(self) -> None:
        await asyncio.get_running_loop().run_in_executor(self._thread, self._connection.close)
        self._thread.shutdown(wait=False)

    def _open(self) -> sqlite3.Connection:
        try:
            connection = sqlite3.connect(self._path, timeout=_BUSY_TIMEOUT_S, check_same_thread=False)
        except sqlite3.Error as error:
            raise self._failed(error) from error
        try:
            connection.execute("PRAGMA journal_mode = WAL")
            connection.execute("PRAGMA synchronous = NORMAL")
            connection.isolation_level = None
            connection.execute("BEGIN IMMEDIATE")
            (version,) = connection.execute("PRAGMA user_version").fetchone()
            if version == 0:
                for statement in filter(str.strip, _SCHEMA.split(";\n")):
                    connection.execute(statement)
                connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
                version = SCHEMA_VERSION
            if version == SCHEMA_VERSION:
                connection.execute(_CLAIMS)
                connection.execute(_CAMERAS)
            connection.execute("COMMIT")
        except sqlite3.Error as error:
            connection.close()
            raise self._failed(error) from error
        if version != SCHEMA_VERSION:
            connection.close()
            raise GridStoreUnavailable(
                f"The grid store {self._path} has version {version}.",
                allowed=f"version {SCHEMA_VERSION}, or a new file",
                setting="grid_store_path",
            )
        return connection

    async def _run(self, function: Callable[..., R], *args: Any, reading: bool = False) -> R:
        return await asyncio.get_running_loop().run_in_executor(
            self._thread, self._transaction, function, args, reading
        )

    def _transaction(self, function: Callable[..., R], args: tuple[Any, ...], reading: bool) -> R:
        """What ``function`` returns, once it is on disk; of one that only reads, even if its use cannot be noted."""
        try:
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                self._forget()
                result = function(*args)
                self._commit(reading)
            except BaseException:
                if self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")
                raise
        except sqlite3.Error as error:
            raise self._failed(error) from error
        return result

    def _commit(self, reading: bool) -> None:
        try:
            self._connection.execute("COMMIT")
        except sqlite3.OperationalError as error:
            if not reading or error.sqlite_errorcode != sqlite3.SQLITE_FULL:
                raise
            if self._connection.in_transaction:
                self._connection.execute("ROLLBACK")

    def _failed(self, error: sqlite3.Error) -> GridStoreUnavailable:
        return GridStoreUnavailable(f"The grid store failed: {error}.", setting="grid_store_path")

    def _put(self, record: GridRecord) -> None:
        grid, provenance = record.grid, orjson.dumps(record.provenance())
        row = (record.id, grid.rows, grid.columns, grid.source.astype("<f4").tobytes(), provenance)
        self._connection.execute("INSERT OR REPLACE INTO grids VALUES (?, ?, ?, ?, ?, ?)", (*row, self._clock()))
        self._bound("grids")

    def _get(self, grid_id: str) -> GridRecord:
        query = "UPDATE grids SET used_at = ? WHERE id = ? RETURNING rows, columns, source, provenance"
        found = self._connection.execute(query, (self._clock(), grid_id)).fetchall()
        if not found:
            raise GridNotFound(f"No grid is stored as {grid_id!r}.")
        rows, columns, source, provenance = found[0]
        try:
            grid = Grid(np.frombuffer(source, dtype="<f4").reshape(rows, columns, 2))
            stand_in = Grid.identity(2, 2).to_dict()
            record = GridRecord.from_dict({**orjson.loads(provenance), "grid": stand_in})
        except (InvalidInput, ValueError) as error:
            raise GridStoreUnavailable(f"The stored grid {grid_id} is damaged.", setting="grid_store_path") from error
        return dataclasses.replace(record, grid=grid)

    def _delete(self, grid_id: str) -> None:
        if not self._connection.execute("DELETE FROM grids WHERE id = ?", (grid_id,)).rowcount:
            raise GridNotFound(f"No grid is stored as {grid_id!r}.")

    def _bind_stream(self, stream_id: str, grid_id: str, replace: bool) -> str:
        if not replace and (bound := self._stream_grid(stream_id)) is not None:
            return bound
        row = (stream_id, grid_id, self._clock())
        self._connection.execute("INSERT OR REPLACE INTO streams VALUES (?, ?, ?)", row)
        self._bound("streams")
        return grid_id

    def _stream_grid(self, stream_id: str) -> str | None:
        now = self._clock()
        query = "UPDATE streams SET used_at = ? WHERE id = ? RETURNING grid_id"
        found = self._connection.execute(query, (now, stream_id)).fetchall()
        if not found:
            return None
        grid_id: str = found[0][0]
        kept = self._connection.execute("UPDATE grids SET used_at = ? WHERE id = ?", (now, grid_id)).rowcount
        return grid_id if kept else None

    def _claim_stream(self, stream_id: str, token: str, lease_s: float) -> bool:
        now = self._clock()
        self._connection.execute("DELETE FROM claims WHERE expires_at <= ?", (now,))
        held = self._connection.execute("SELECT token FROM claims WHERE stream_id = ?", (stream_id,)).fetchone()
        if held is not None and held[0] != token:
            return False
        self._connection.execute("INSERT OR REPLACE INTO claims VALUES (?, ?, ?)", (stream_id, token, now + lease_s))
        return True

    def _release_stream(self, stream_id: str, token: str) -> None:
        self._connection.execute("DELETE FROM claims WHERE stream_id = ? AND token = ?", (stream_id, token))

    def _camera(self, name: str) -> bytes | None:
        query = "UPDATE cameras SET used_at = ? WHERE id = ? RETURNING record"
        found = self._connection.execute(query, (self._clock(), name)).fetchall()
        return found[0][0] if found else None

    def _swap_camera(self, name: str, known: bytes | None, value: bytes | None) -> bool:
        if self._camera(name) != known:
            return False
        if value is None:
            self._connection.execute("DELETE FROM cameras WHERE id = ?", (name,))
        else:
            row = (name, value, self._clock())
            self._connection.execute("INSERT OR REPLACE INTO cameras VALUES (?, ?, ?)", row)
            self._bound("cameras")
        return True

    def _forget(self) -> None:
        for table in _TABLES:
            self._connection.execute(f"DELETE FROM {table} WHERE used_at < ?", (self._clock() - self._ttl_s,))

    def _bound(self, table: str) -> None:
        (count,) = self._connection.execute(f"SELECT count(*) FROM {table}").fetchone()
        if count > self._entries:
            query = f"DELETE FROM {table} WHERE id IN (SELECT id FROM {table} ORDER BY used_at LIMIT ?)"
            self._connection.execute(query, (count - self._entries,))


def _steady_clock() -> Callable[[], float]:
    """Seconds since the epoch as they were when this was called, going on evenly."""
    offset_s = time.time() - time.monotonic()
    return lambda: offset_s + time.monotonic()
