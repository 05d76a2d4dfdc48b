"""One suite over every grid store."""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import AsyncIterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from tests.fakes import RecordingMeter, barrel_guides
from unbend_service.adapters.grid_stores.memory import MemoryGridStore
from unbend_service.adapters.grid_stores.redis import RedisGridStore
from unbend_service.adapters.grid_stores.sheltered import ShelteredGridStore
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


@pytest.fixture
def clock() -> Clock:
    return Clock()


def built(kind: str, settings: Settings, clock: Clock) -> GridStore:
    match kind:
        case "memory":
            return MemoryGridStore(settings, clock)
        case "sqlite":
            return SqliteGridStore(settings, clock)
    shared = RedisGridStore(settings, RecordingMeter(), clock)
    if kind == "redis":
        return shared
    return ShelteredGridStore(
        shared, MemoryGridStore(settings, clock), RecordingMeter(), retry_s=1.0, owed_entries=ENTRIES
    )


@pytest.fixture(params=["memory", "sqlite", "redis", "sheltered"])
async def store(request: pytest.FixtureRequest, tmp_path: Path, clock: Clock) -> AsyncIterator[GridStore]:
    settings = Settings(grid_store_entries=ENTRIES, grid_store_ttl_s=TTL_S, grid_store_path=tmp_path / "grids.sqlite3")
    if request.param in ("redis", "sheltered"):
        port = request.getfixturevalue("redis").port
        chosen = {
            "redis_url": f"redis://127.0.0.1:{port}/0",
            "redis_prefix": f"t{secrets.token_hex(6)}",
            "redis_timeout_s": 10.0,
        }
        settings = settings.model_copy(update=chosen)
    made = built(request.param, settings, clock)
    yield made
    await made.close()


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


async def test_the_first_grid_of_a_stream_wins_unless_it_is_replaced(store: GridStore) -> None:
    """Two estimates of one stream end in one grid: the later one learns of the earlier."""
    first, second = record(0.01), record(0.02)
    await store.put(first)
    await store.put(second)
    assert await store.bind_stream("camera-7", first.id, replace=False) == first.id
    assert await store.bind_stream("camera-7", second.id, replace=False) == first.id
    assert await store.stream_grid("camera-7") == first.id
    assert await store.bind_stream("camera-7", second.id) == second.id
    await store.delete(second.id)
    assert await store.bind_stream("camera-7", first.id, replace=False) == first.id


async def test_one_of_many_may_estimate_a_stream(store: GridStore) -> None:
    """A claim is one token's until it is given back; another stream is another claim."""
    taken = await asyncio.gather(*(store.claim_stream("camera-7", f"token-{i}", 30.0) for i in range(8)))
    assert taken.count(True) == 1
    holder = f"token-{taken.index(True)}"
    assert await store.claim_stream("camera-7", holder, 30.0)
    assert await store.claim_stream("camera-8", "other", 30.0)
    await store.release_stream("camera-7", "other")
    assert not await store.claim_stream("camera-7", "other", 30.0)
    await store.release_stream("camera-7", holder)
    assert await store.claim_stream("camera-7", "other", 30.0)


async def test_a_claim_lapses_unless_it_is_renewed(store: GridStore, clock: Clock) -> None:
    """A replica that dies over an estimate keeps nobody from it for longer than its lease."""

    async def pass_by(seconds: float) -> None:
        clock.now += seconds
        await asyncio.sleep(seconds)  # redis counts by its own clock

    assert await store.claim_stream("camera-7", "dead", 0.3)
    await pass_by(0.2)
    assert await store.claim_stream("camera-7", "dead", 0.3)
    await pass_by(0.2)
    assert not await store.claim_stream("camera-7", "heir", 0.3)
    await pass_by(0.2)
    assert await store.claim_stream("camera-7", "heir", 0.3)


async def test_what_is_remembered_of_a_camera_is_swapped_for_what_is_known(store: GridStore) -> None:
    """Of two that write at the same time the second is told, and nothing is overwritten."""
    assert await store.camera("dashcam") is None
    assert await store.swap_camera("dashcam", None, b"one")
    assert not await store.swap_camera("dashcam", None, b"two")
    assert not await store.swap_camera("dashcam", b"zero", b"two")
    assert await store.camera("dashcam") == b"one"

    assert await store.swap_camera("dashcam", b"one", b"two")
    assert await store.camera("dashcam") == b"two"
    assert await store.swap_camera("dashcam", b"two", None)
    assert await store.camera("dashcam") is None


async def test_cameras_are_bounded_and_forgotten_like_grids(store: GridStore, clock: Clock) -> None:
    for name in "abcd":
        assert await store.swap_camera(name, None, name.encode())

    assert await store.camera("a") is None
    assert await store.camera("d") == b"d"

    clock.now += TTL_S + 1
    assert await store.camera("d") is None
