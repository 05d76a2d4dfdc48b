from __future__ import annotations

import asyncio

import pytest

from unbend_service.application.admission import Admission
from unbend_service.domain.errors import Draining


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
