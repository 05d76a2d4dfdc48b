from __future__ import annotations

import asyncio
import threading

import pytest

from tests.fakes import RecordingMeter
from unbend_service.application.blocking import BlockingWork
from unbend_service.domain.errors import QueueFull


async def test_work_runs_off_the_event_loop_and_its_stage_is_counted() -> None:
    meter = RecordingMeter()
    blocking = BlockingWork(1, 4, meter)
    assert await blocking.run("decode", threading.get_ident) != threading.get_ident()
    assert meter.stages == {"decode": 1}
    blocking.close()


async def test_more_work_than_may_wait_is_refused_at_once_and_room_comes_back() -> None:
    meter = RecordingMeter()
    blocking = BlockingWork(1, 1, meter)
    gate = threading.Event()
    held = [asyncio.create_task(blocking.run("decode", gate.wait)) for _ in range(2)]
    await asyncio.sleep(0)
    with pytest.raises(QueueFull) as refused:
        await blocking.run("decode", gate.wait)
    assert refused.value.retry_after_s
    assert meter.rejections == {"queue_full": 1}
    gate.set()
    await asyncio.gather(*held)
    assert await blocking.run("decode", gate.wait)
    blocking.close()


async def test_an_error_reaches_the_caller_and_frees_its_place() -> None:
    blocking = BlockingWork(1, 0, RecordingMeter())
    for _ in range(3):
        with pytest.raises(ZeroDivisionError):
            await blocking.run("decode", divmod, 1, 0)
    blocking.close()


async def test_who_waits_for_a_decoder_keeps_nobody_from_work() -> None:
    """All decoders may be busy, and pictures that were decoded before are encoded all the same."""
    blocking = BlockingWork(1, 8, RecordingMeter(), waiting=2)
    gate = threading.Event()
    held = [asyncio.create_task(blocking.run("decode", gate.wait)) for _ in range(4)]
    assert await asyncio.wait_for(blocking.run("encode", lambda: "encoded"), 10) == "encoded"
    gate.set()
    assert await asyncio.gather(*held) == [True] * 4
    blocking.close()
