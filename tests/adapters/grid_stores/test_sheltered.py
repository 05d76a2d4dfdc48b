from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest

from benchmarks.companions import Companion, redis_server
from tests.companions import started
from tests.fakes import RecordingMeter, barrel_guides
from unbend_service.adapters.grid_stores.memory import MemoryGridStore
from unbend_service.adapters.grid_stores.redis import RedisGridStore
from unbend_service.adapters.grid_stores.sheltered import ShelteredGridStore
from unbend_service.domain.errors import GridNotFound, GridStoreUnavailable
from unbend_service.domain.grid import Grid
from unbend_service.domain.records import GridRecord
from unbend_service.settings import Settings

FIRST, SECOND, THIRD = (GridRecord(Grid.from_map(barrel_guides(bend), 9, 9)) for bend in (0.01, 0.02, 0.03))


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Companion]:
    """A redis-server of this test's own, to be paused, killed and started again."""
    running = started(lambda: redis_server(tmp_path))
    yield running
    running.stop()


class Replica:
    """One replica's view of the store."""

    def __init__(self, server: Companion) -> None:
        settings = Settings(redis_url=f"redis://127.0.0.1:{server.port}/0", redis_timeout_s=1.0)
        self.meter = RecordingMeter()
        shared = RedisGridStore(settings, self.meter)
        self.store = ShelteredGridStore(shared, MemoryGridStore(settings), self.meter, retry_s=0.1, owed_entries=8)

    async def recovered(self) -> None:
        end = time.monotonic() + 10
        while self.meter.store_up[-1:] != [True]:
            assert time.monotonic() < end, "the shared store was not found again"
            await asyncio.sleep(0.02)


@pytest.fixture
async def replicas(server: Companion) -> AsyncIterator[tuple[Replica, Replica]]:
    pair = Replica(server), Replica(server)
    yield pair
    for replica in pair:
        await replica.store.close()


async def test_known_grids_and_streams_outlive_the_server(server: Companion, replicas: tuple[Replica, Replica]) -> None:
    """While the shared store is away a replica goes on with what it has used itself, from another replica or not."""
    one, other = replicas
    await one.store.put(FIRST)
    await one.store.bind_stream("camera-7", FIRST.id)
    assert await other.store.stream_grid("camera-7") == FIRST.id
    await other.store.get(FIRST.id)
    server.kill()
    for replica in replicas:
        assert await replica.store.stream_grid("camera-7") == FIRST.id
        assert (await replica.store.get(FIRST.id)).to_dict() == FIRST.to_dict()
        assert replica.meter.store_up == [False]
        assert replica.meter.store["get", "local"] == 1


async def test_what_only_the_server_knows_is_unavailable_and_not_unknown(
    server: Companion, replicas: tuple[Replica, Replica]
) -> None:
    """A caller is not told that a grid does not exist, nor that it was deleted, by one who cannot know."""
    one, other = replicas
    await one.store.put(FIRST)
    server.kill()
    with pytest.raises(GridStoreUnavailable):
        await other.store.get(FIRST.id)
    with pytest.raises(GridStoreUnavailable):
        await one.store.delete(FIRST.id)
    assert (await one.store.get(FIRST.id)).id == FIRST.id


async def test_only_the_first_call_waits_for_a_server_that_hangs(
    server: Companion, replicas: tuple[Replica, Replica]
) -> None:
    """A hundred look-ups during a hang take no longer than one time-out together."""
    store = replicas[0].store
    await store.put(FIRST)
    server.pause()
    start = time.monotonic()
    for _ in range(100):
        assert (await store.get(FIRST.id)).id == FIRST.id
    assert time.monotonic() - start < 4.0
    server.resume()
    await replicas[0].recovered()
    assert (await store.get(FIRST.id)).id == FIRST.id
    assert replicas[0].meter.store["get", "shared"] == 1


async def test_what_was_stored_meanwhile_is_handed_in(server: Companion, replicas: tuple[Replica, Replica]) -> None:
    """After the outage, even if the server came back empty, the other replicas find what was estimated in it."""
    one, other = replicas
    await one.store.put(FIRST)
    server.kill()
    await one.store.put(SECOND)
    assert await one.store.bind_stream("camera-7", SECOND.id, replace=False) == SECOND.id
    server.start()
    await one.recovered()
    assert await other.store.stream_grid("camera-7") == SECOND.id
    assert (await other.store.get(SECOND.id)).id == SECOND.id


async def test_the_grid_from_before_the_outage_wins(server: Companion, replicas: tuple[Replica, Replica]) -> None:
    """A stream that had to be estimated again on a replica that did not know it goes back to the grid it had."""
    one, other = replicas
    await one.store.put(FIRST)
    await one.store.bind_stream("camera-7", FIRST.id, replace=False)
    server.pause()
    assert await other.store.stream_grid("camera-7") is None
    assert await other.store.claim_stream("camera-7", "token", 5.0)
    await other.store.put(SECOND)
    assert await other.store.bind_stream("camera-7", SECOND.id, replace=False) == SECOND.id
    assert await other.store.stream_grid("camera-7") == SECOND.id
    server.resume()
    await other.recovered()
    for replica in replicas:
        assert await replica.store.stream_grid("camera-7") == FIRST.id


async def test_a_grid_that_was_asked_for_replaces_the_one_before(
    server: Companion, replicas: tuple[Replica, Replica]
) -> None:
    """Whoever named the grid of a stream during the outage finds it bound afterwards."""
    one, other = replicas
    await one.store.put(FIRST)
    await one.store.bind_stream("camera-7", FIRST.id)
    server.pause()
    await other.store.put(THIRD)
    await other.store.bind_stream("camera-7", THIRD.id)
    server.resume()
    await other.recovered()
    assert await one.store.stream_grid("camera-7") == THIRD.id


async def test_an_unknown_grid_is_no_outage(replicas: tuple[Replica, Replica]) -> None:
    """A server that answers no is one that answers."""
    with pytest.raises(GridNotFound):
        await replicas[0].store.get("g-none")
    assert replicas[0].meter.store_up == []
    assert replicas[0].meter.store["get", "shared"] == 1
