"""The grid store under kill -9, on a full disk, and when the clock jumps."""

from __future__ import annotations

import asyncio
import os
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from unbend_service.adapters.grid_stores.sqlite import SqliteGridStore
from unbend_service.domain.errors import GridStoreUnavailable
from unbend_service.domain.grid import Grid
from unbend_service.domain.records import GridRecord
from unbend_service.settings import Settings

WRITER = """
import asyncio, sys
from pathlib import Path
from unbend_service.adapters.grid_stores.sqlite import SqliteGridStore
from unbend_service.domain.grid import Grid
from unbend_service.domain.records import GridRecord
from unbend_service.settings import Settings

async def write():
    store = SqliteGridStore(Settings(grid_store_path=Path(sys.argv[1])))
    for n in range(100000):
        record = GridRecord(Grid.from_map(lambda p: p * (0.5 + n / 1e6), 65, 65))
        await store.put(record)
        print(record.id, flush=True)

asyncio.run(write())
"""


def record(scale: float, points: int = 65) -> GridRecord:
    return GridRecord(Grid.from_map(lambda p: p * scale, points, points))


def killed_writer(path: Path, after: int) -> list[str]:
    """Ids that a process stored and acknowledged before it was killed in the middle of writing."""
    acknowledged = []
    with subprocess.Popen([sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout is not None
        for line in writer.stdout:
            if line.endswith("\n"):
                acknowledged.append(line.strip())
            if len(acknowledged) == after:
                writer.kill()
    assert writer.returncode == -signal.SIGKILL
    return acknowledged


async def test_what_was_stored_survives_kill_9_in_the_middle_of_a_write(tmp_path: Path) -> None:
    """Every grid that was acknowledged is there, whole, and the file is sound."""
    path = tmp_path / "grids.sqlite3"
    acknowledged = killed_writer(path, 3) + killed_writer(path, 40)
    store = SqliteGridStore(Settings(grid_store_path=path))
    for grid_id in set(acknowledged):
        assert (await store.get(grid_id)).id == grid_id
    await store.close()
    connection = sqlite3.connect(path)
    assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    connection.close()


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of half a megabyte."""
    disk = tmp_path / "disk"
    disk.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=512k", "tmpfs", str(disk)]
    if os.geteuid() != 0 or subprocess.run(command, capture_output=True, check=False).returncode != 0:
        pytest.skip("a small file system can be mounted by root only")
    yield disk
    subprocess.run(["umount", "--lazy", str(disk)], check=True)


def fill(ballast: Path) -> None:
    """Takes all that is left of the disk."""
    with suppress(OSError), ballast.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))


async def test_a_full_disk_is_an_error_with_a_name_and_passes(small_disk: Path) -> None:
    """Writing is refused by name, what is stored is still read, and with room again all goes on."""
    store = SqliteGridStore(Settings(grid_store_path=small_disk / "grids.sqlite3"))
    known = record(0.9, 9)
    await store.put(known)
    await store.bind_stream("camera-7", known.id)
    ballast = small_disk / "ballast"
    fill(ballast)
    with pytest.raises(GridStoreUnavailable, match="full") as refusal:
        await asyncio.gather(*(store.put(record(0.5 + n / 100)) for n in range(20)))
    assert refusal.value.setting == "grid_store_path"
    for _ in range(50):
        assert (await store.get(known.id)).id == known.id
        assert await store.stream_grid("camera-7") == known.id
    ballast.unlink()
    await store.put(record(0.7))
    assert (await store.get(record(0.7).id)).id == record(0.7).id
    await store.close()


async def test_a_clock_that_jumps_makes_no_grid_too_old(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The system clock may be set a century ahead or back while the service runs."""
    store = SqliteGridStore(Settings(grid_store_path=tmp_path / "grids.sqlite3", grid_store_ttl_s=60))
    await store.put(record(0.9, 9))
    now_s = time.time()
    for jumped_s in (now_s + 3e9, now_s - 1e9):
        monkeypatch.setattr(time, "time", lambda jumped_s=jumped_s: jumped_s)
        assert (await store.get(record(0.9, 9).id)).id == record(0.9, 9).id
    await store.close()
