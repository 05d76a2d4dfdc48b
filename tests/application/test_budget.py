from __future__ import annotations

import asyncio

import pytest

from unbend_service.application.budget import FrameMemory, MemoryBudget
from unbend_service.domain.errors import MemoryFull


def test_requests_share_one_bound() -> None:
    """What one holds the other cannot have, until it is given back."""
    budget = MemoryBudget(100, "bodies_bytes")
    with budget.holding() as first, budget.holding() as second:
        first.grow(60)
        with pytest.raises(MemoryFull) as caught:
            second.grow(50)
        assert caught.value.setting == "bodies_bytes"
        assert caught.value.retry_after_s
        second.grow(40)
        assert budget.used_bytes == 100
    assert budget.used_bytes == 0


def test_what_is_only_announced_is_not_taken() -> None:
    """A caller who announces much and sends nothing keeps nobody out."""
    budget = MemoryBudget(100, "bodies_bytes")
    with budget.holding() as first, budget.holding() as second:
        first.expect(100)
        second.grow(100)
        with pytest.raises(MemoryFull):
            first.expect(1)


def test_a_request_that_fails_gives_back_too() -> None:
    """No error leaks memory out of the budget."""
    budget = MemoryBudget(100, "bodies_bytes")

    def fail() -> None:
        with budget.holding() as holding:
            holding.grow(70)
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert budget.used_bytes == 0


async def test_a_stream_that_holds_nothing_never_waits() -> None:
    """However much the others hold; who holds a frame goes on when one of them lets go."""
    memory = FrameMemory(100)
    memory.take(100)
    assert not memory.full(0)
    assert memory.full(10)
    waiting = asyncio.create_task(memory.changed())
    await asyncio.sleep(0)
    assert not waiting.done()
    memory.give(1)
    await asyncio.wait_for(waiting, 10)
    assert not memory.full(10)
