from __future__ import annotations

import asyncio

import pytest

from unbend_service.application.deadlines import deadline
from unbend_service.domain.errors import DeadlineExceeded


async def test_work_is_cancelled_when_its_time_is_over() -> None:
    """Whatever the call waits for hears of it, and the caller gets an error with a name."""
    cancelled: list[str] = []

    async def work() -> None:
        async with deadline(0.01):
            try:
                await asyncio.sleep(10)
            except asyncio.CancelledError:
                cancelled.append("the work")
                raise

    with pytest.raises(DeadlineExceeded, match=r"0\.01 s"):
        await work()
    assert cancelled == ["the work"]


async def test_other_time_outs_stay_what_they_are() -> None:
    """An inner limit is not taken for the caller's; without one there is none."""
    with pytest.raises(TimeoutError) as failure:
        async with deadline(10):
            raise TimeoutError("of something else")
    assert not isinstance(failure.value, DeadlineExceeded)
    async with deadline(None):
        await asyncio.sleep(0)
