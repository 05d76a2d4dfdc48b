from __future__ import annotations

import asyncio

import pytest

from tests.fakes import barrel_guides
from unbend_service.adapters.grid_stores.memory import MemoryGridStore
from unbend_service.application.stream_lead import StreamLead
from unbend_service.domain.grid import Grid
from unbend_service.domain.records import GridRecord
from unbend_service.settings import Settings

OURS, THEIRS = (GridRecord(Grid.from_map(barrel_guides(bend), 9, 9)) for bend in (0.01, 0.02))


@pytest.fixture
def store() -> MemoryGridStore:
    return MemoryGridStore(Settings())


async def test_a_leader_that_takes_long_keeps_the_lead(store: MemoryGridStore) -> None:
    """The lease is renewed as long as the leader lives."""
    leader, follower = StreamLead(store, "camera-7", 0.15), StreamLead(store, "camera-7", 0.15)
    assert await leader.win() is None
    waiting = asyncio.create_task(follower.win())
    await asyncio.sleep(0.5)
    assert not waiting.done()
    await store.put(OURS)
    await leader.bind(OURS, replace=False)
    made = await waiting
    assert made is not None
    assert made.id == OURS.id


async def test_one_who_was_thought_dead_takes_the_grid_that_the_stream_was_given(store: MemoryGridStore) -> None:
    """An estimate that comes late never changes the grid of a stream that goes on elsewhere."""
    late, heir = StreamLead(store, "camera-7", 30.0), StreamLead(store, "camera-7", 30.0)
    assert await late.win() is None
    for record in (OURS, THEIRS):
        await store.put(record)
    assert (await heir.bind(THEIRS, replace=False)).id == THEIRS.id
    assert (await late.bind(OURS, replace=False)).id == THEIRS.id
    assert await store.stream_grid("camera-7") == THEIRS.id


async def test_a_new_estimate_that_was_asked_for_replaces_the_grid(store: MemoryGridStore) -> None:
    """The client's word counts."""
    for record in (OURS, THEIRS):
        await store.put(record)
    await store.bind_stream("camera-7", THEIRS.id)
    assert (await StreamLead(store, "camera-7", 30.0).bind(OURS, replace=True)).id == OURS.id
    assert await store.stream_grid("camera-7") == OURS.id
