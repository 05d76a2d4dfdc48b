from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest

from tests.fakes import barrel_guides
from unbend_service.adapters.grid_stores.sqlite import SqliteGridStore
from unbend_service.domain.errors import GridStoreUnavailable
from unbend_service.domain.grid import Grid
from unbend_service.domain.records import GridRecord
from unbend_service.settings import Settings

RECORD = GridRecord(Grid.from_map(barrel_guides(), 9, 9))


def settings(path: Path) -> Settings:
    return Settings(grid_store_path=path)


async def test_grids_survive_a_restart(tmp_path: Path) -> None:
    """Grids and stream bindings are there again after the service was stopped and started."""
    path = tmp_path / "grids.sqlite3"
    store = SqliteGridStore(settings(path))
    await store.put(RECORD)
    await store.bind_stream("camera-7", RECORD.id)
    await store.close()
    store = SqliteGridStore(settings(path))
    assert (await store.get(RECORD.id)).to_dict() == RECORD.to_dict()
    assert await store.stream_grid("camera-7") == RECORD.id
    await store.close()


async def test_two_processes_share_a_file(tmp_path: Path) -> None:
    """What one writer stores, another finds."""
    path = tmp_path / "grids.sqlite3"
    one, other = SqliteGridStore(settings(path)), SqliteGridStore(settings(path))
    await one.put(RECORD)
    assert (await other.get(RECORD.id)).id == RECORD.id
    await one.close()
    await other.close()


def test_a_broken_file_is_named(tmp_path: Path) -> None:
    """A file that is no grid store is refused with the name of the setting, and is not overwritten."""
    path = tmp_path / "grids.sqlite3"
    path.write_bytes(b"not a database" * 100)
    with pytest.raises(GridStoreUnavailable, match="grid_store_path"):
        SqliteGridStore(settings(path))
    assert path.read_bytes() == b"not a database" * 100
    with pytest.raises(GridStoreUnavailable, match="grid_store_path"):
        SqliteGridStore(settings(tmp_path / "no" / "such" / "folder.sqlite3"))


def test_a_store_of_another_version_is_refused(tmp_path: Path) -> None:
    """A file of a later version is left alone."""
    path = tmp_path / "grids.sqlite3"
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA user_version = 99")
    connection.close()
    with pytest.raises(GridStoreUnavailable, match="version 99"):
        SqliteGridStore(settings(path))


async def test_a_full_disk_is_a_typed_error(tmp_path: Path) -> None:
    """A disk that fills up fails the call, not the store: what was stored before is still there."""
    store = SqliteGridStore(settings(tmp_path / "grids.sqlite3"))
    await store.put(RECORD)
    (pages,) = store._connection.execute("PRAGMA page_count").fetchone()
    store._connection.execute(f"PRAGMA max_page_count = {pages}")
    with pytest.raises(GridStoreUnavailable, match="full"):
        await store.put(GridRecord(Grid.identity(200, 200)))
    assert (await store.get(RECORD.id)).id == RECORD.id
    await store.close()


async def test_damaged_rows_are_a_typed_error(tmp_path: Path) -> None:
    """A row that somebody else spoilt is reported as damage of the store."""
    path = tmp_path / "grids.sqlite3"
    store = SqliteGridStore(settings(path))
    await store.put(RECORD)
    with sqlite3.connect(path) as connection:
        connection.execute("UPDATE grids SET source = x'00'")
    connection.close()
    with pytest.raises(GridStoreUnavailable, match="damaged"):
        await store.get(RECORD.id)
    await store.close()
