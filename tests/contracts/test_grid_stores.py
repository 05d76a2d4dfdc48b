"""One suite over every grid store."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from tests.fakes import barrel_guides
from unbend_service.adapters.grid_stores.memory import MemoryGridStore
from unbend_service.adapters.grid_stores.sqlite import SqliteGridStore
from unbend_service.application.ports import GridStore
from unbend_service.domain.errors import GridNotFound
from unbend_service.domain.grid import Grid
from unbend_service.domain.records import GridRecord, Outcome, Reason
from unbend_service.settings import Settings

TTL_S = 100.0
ENTRIES = 3


@dataclass
class Clock:
    now: float = 1_000_000.0

    def __call__(self) -> float:
        self.now += 0.001
        return self.now


Build = Callable[[Settings, Clock], GridStore]


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture(params=[MemoryGridStore, SqliteGridStore], ids=["memory", "sqlite"])
async def store(request: pytest.FixtureRequest, tmp_path: Path, clock: Clock):
    settings = Settings(grid_store_entries=ENTRIES, grid_store_ttl_s=TTL_S, grid_store_path=tmp_path / "grids.sqlite3")
    built: GridStore = request.param(settings, clock)
    yield built
    await built.close()


def record(bend: float = 0.06) -> GridRecord:
    guides = barrel_guides(bend)
    return GridRecord(
        grid=Grid.from_map(guides, 9, 11),
        guides=guides,
        confidence=0.75,
        confidence_kind="mirror_agreement",
        outcome=Outcome.LEFT_ALONE,
        reason=Reason.LOW_CONFIDENCE,
        strength=0.5,
        model="first",
    )


async def test_a_record_comes_back_whole(store: GridStore) -> None:
    """What was put comes back: the lattice to the last bit, the guides, and what was decided."""
    await store.put(record())
    back = await store.get(record().id)
    np.testing.assert_array_equal(back.grid.source, record().grid.source)
    assert back.id == record().id
    assert back.to_dict() == record().to_dict()


async def test_a_grid_without_guides_comes_back(store: GridStore) -> None:
    """Grids that came from elsewhere have no guides, and still have none afterwards."""
    await store.put(GridRecord(Grid.identity(5, 5)))
    assert (await store.get(Grid.identity(5, 5).id)).guides is None


async def test_an_unknown_id_is_named(store: GridStore) -> None:
    """Asking for, or deleting, what is not there says so."""
    with pytest.raises(GridNotFound, match="g-none"):
        await store.get("g-none")
    with pytest.raises(GridNotFound, match="g-none"):
        await store.delete("g-none")


async def test_a_deleted_grid_is_gone(store: GridStore) -> None:
    """After a delete nobody gets the grid, and a second delete says so."""
    await store.put(record())
    await store.delete(record().id)
    with pytest.raises(GridNotFound):
        await store.get(record().id)
    with pytest.raises(GridNotFound):
        await store.delete(record().id)


async def test_the_latest_record_of_an_id_counts(store: GridStore) -> None:
    """Putting the same grid again replaces what is known of it and takes no second place."""
    for confidence in (0.1, 0.2, 0.3, 0.4, 0.5):
        await store.put(replace(record(), confidence=confidence))
    assert (await store.get(record().id)).confidence == 0.5


async def test_the_least_recently_used_goes_first(store: GridStore) -> None:
    """The store is bounded; a grid in use outlives one that nobody asks for."""
    first, second, third, fourth = (record(bend) for bend in (0.01, 0.02, 0.03, 0.04))
    for each in (first, second, third):
        await store.put(each)
    await store.get(first.id)
    await store.put(fourth)
    with pytest.raises(GridNotFound):
        await store.get(second.id)
    for each in (first, third, fourth):
        assert (await store.get(each.id)).id == each.id


async def test_time_to_live_counts_from_the_last_use(store: GridStore, clock: Clock) -> None:
    """A grid that is used stays; one that is not is gone after its time."""
    await store.put(record())
    for _ in range(3):
        clock.now += 0.9 * TTL_S
        await store.get(record().id)
    clock.now += 1.1 * TTL_S
    with pytest.raises(GridNotFound):
        await store.get(record().id)
    await store.put(record())
    clock.now += 1.1 * TTL_S
    with pytest.raises(GridNotFound):
        await store.delete(record().id)


async def test_a_stream_keeps_its_grid(store: GridStore) -> None:
    """A resumed stream finds the grid it had; a stream that was never bound has none."""
    await store.put(record())
    await store.bind_stream("camera-7", record().id)
    assert await store.stream_grid("camera-7") == record().id
    assert await store.stream_grid("camera-8") is None
    other = record(0.02)
    await store.put(other)
    await store.bind_stream("camera-7", other.id)
    assert await store.stream_grid("camera-7") == other.id


async def test_a_stream_whose_grid_is_gone_has_none(store: GridStore) -> None:
    """A binding never leads to a grid that cannot be fetched."""
    await store.put(record())
    await store.bind_stream("camera-7", record().id)
    await store.delete(record().id)
    assert await store.stream_grid("camera-7") is None


async def test_a_stream_in_use_keeps_its_grid_alive(store: GridStore, clock: Clock) -> None:
    """Asking for the grid of a stream counts as a use of both."""
    await store.put(record())
    await store.bind_stream("camera-7", record().id)
    for _ in range(3):
        clock.now += 0.9 * TTL_S
        assert await store.stream_grid("camera-7") == record().id
    clock.now += 1.1 * TTL_S
    assert await store.stream_grid("camera-7") is None


async def test_bindings_are_bounded(store: GridStore) -> None:
    """Streams that come and go do not fill the store."""
    await store.put(record())
    for i in range(ENTRIES + 1):
        await store.bind_stream(f"camera-{i}", record().id)
    assert await store.stream_grid("camera-0") is None
    assert await store.stream_grid(f"camera-{ENTRIES}") == record().id


async def test_concurrent_use_is_safe(store: GridStore) -> None:
    """Many requests at once each get the record they asked for."""
    records = [record(bend) for bend in (0.01, 0.02, 0.03)]
    await asyncio.gather(*(store.put(each) for each in records * 5))
    found = await asyncio.gather(*(store.get(each.id) for each in records * 20))
    assert [each.id for each in found] == [each.id for each in records * 20]
