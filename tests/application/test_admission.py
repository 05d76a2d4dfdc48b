from __future__ import annotations

import asyncio

import pytest

from unbend_service.application.admission import Admission
from unbend_service.domain.errors import Draining, QueueFull


async def test_draining_waits_for_calls_under_way_and_refuses_new_ones() -> None:
    admission = Admission()
    release = asyncio.Event()

    async def call() -> None:
        with admission.admitted():
            await release.wait()

    running = asyncio.create_task(call())
    await asyncio.sleep(0)
    draining = asyncio.create_task(admission.drain(5))
    await asyncio.sleep(0)
    with pytest.raises(Draining), admission.admitted():
        pass
    assert not draining.done()
    release.set()
    assert await draining
    await running
    assert admission.active == 0


async def test_a_drain_that_runs_out_of_time_says_so() -> None:
    admission = Admission()
    with admission.admitted():
        assert not await admission.drain(0.01)


async def test_one_single_call_too_many_is_refused_at_once_and_streams_are_not_counted() -> None:
    """The refusal names the setting and says when to come back; a place that was left is taken by the next."""
    admission = Admission(2)
    with admission.admitted(), admission.admitted(single=True):
        with admission.admitted(single=True):
            with pytest.raises(QueueFull) as refused, admission.admitted(single=True):
                pass
            assert refused.value.setting == "queue_frames"
            assert refused.value.retry_after_s
            with admission.admitted():
                assert admission.active == 4
        with admission.admitted(single=True):
            assert admission.active == 3
