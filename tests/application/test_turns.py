from __future__ import annotations

import asyncio

import pytest

from unbend_service.application.turns import Turns
from unbend_service.domain.errors import QueueFull


class Work:
    """Remembers the order in which it was begun, and ends when it may."""

    def __init__(self) -> None:
        self.begun: list[str] = []
        self.may_end = asyncio.Semaphore(0)

    async def of(self, turns: Turns, stream: str) -> None:
        async def work() -> None:
            self.begun.append(stream)
            await self.may_end.acquire()

        await turns.run(stream, work)


async def test_streams_go_in_a_circle_whatever_one_of_them_has_waiting() -> None:
    """A stream with one frame waits for one frame of each other stream, not for all that a greedy one has."""
    turns, work = Turns(1, 1.0), Work()
    tasks = [asyncio.create_task(work.of(turns, "greedy")) for _ in range(6)]
    await asyncio.sleep(0)
    tasks += [asyncio.create_task(work.of(turns, name)) for name in ("modest", "shy", "modest")]
    for _ in tasks:
        await asyncio.sleep(0.001)
        work.may_end.release()
    await asyncio.gather(*tasks)
    assert work.begun[:5] == ["greedy", "greedy", "modest", "shy", "greedy"]
    assert sorted(work.begun[5:]) == ["greedy"] * 3 + ["modest"]


async def test_who_goes_away_leaves_his_turn_to_the_next() -> None:
    """Cancelled while it waits, or in the very moment of its turn: no turn is lost."""
    turns, work = Turns(1, 1.0), Work()
    first = asyncio.create_task(work.of(turns, "a"))
    await asyncio.sleep(0)
    waiting = [asyncio.create_task(work.of(turns, name)) for name in "bcd"]
    await asyncio.sleep(0)
    waiting[0].cancel()
    work.may_end.release()
    await first
    waiting[1].cancel()  # its turn has come, but it has not run yet
    await asyncio.sleep(0.001)
    work.may_end.release()
    await asyncio.wait_for(waiting[2], 5)
    work.may_end.release()
    await asyncio.wait_for(work.of(turns, "e"), 5)


async def test_a_full_queue_is_tried_again_for_a_while() -> None:
    """A stream waits for room; only one that finds none for its patience is refused."""
    turns = Turns(1, 0.5)
    refusals = 3

    async def work() -> str:
        nonlocal refusals
        if refusals:
            refusals -= 1
            raise QueueFull("full")
        return "done"

    assert await turns.run("a", work) == "done"
    refusals = 1_000_000
    with pytest.raises(QueueFull):
        await turns.run("a", work)
    refusals = 0
    assert await turns.run("a", work) == "done"
