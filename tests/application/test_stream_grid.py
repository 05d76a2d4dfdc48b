"""How the grid of a stream comes about, and ends with it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, cast

import numpy as np

from tests.fakes import FakeEstimator
from unbend_service.adapters.grid_stores.memory import MemoryGridStore
from unbend_service.application.blocking import BlockingWork
from unbend_service.application.correction import Correction
from unbend_service.application.estimation import Estimation
from unbend_service.application.ports import Bytes, Estimate
from unbend_service.application.stream_grid import StreamGrid
from unbend_service.application.stream_messages import EstimateOver, RawFormat, StreamConfig
from unbend_service.application.turns import Turns
from unbend_service.domain.frames import Frame, PixelFormat
from unbend_service.settings import Settings


class AtOnce:
    """An estimation that takes no time, and a decision that takes for ever."""

    async def run(self, stage: str, work: Callable[..., Any], *arguments: Any) -> Any:
        if stage == "grid":
            await asyncio.Event().wait()
        return work(*arguments)

    async def of_grey(self, grey: Bytes) -> Estimate:
        return FakeEstimator().estimate(grey)


async def test_a_stream_that_ends_as_its_estimate_does_leaves_nothing_behind() -> None:
    """The estimate is there, but nobody was told yet when the stream is closed: no decision is begun any more."""
    settings, at_once = Settings(), AtOnce()
    grid = StreamGrid(
        StreamConfig(RawFormat(PixelFormat.GRAY8, 64, 48), grid_source=EstimateOver(1)),
        "s",
        cast(Estimation, at_once),
        cast(Correction, None),
        MemoryGridStore(settings),
        cast(BlockingWork, at_once),
        Turns(1, 1.0),
        settings,
    )
    assert not await grid.prepare()
    grid.expect()
    await grid.offer(Frame(PixelFormat.GRAY8, 64, 48, np.zeros(64 * 48, np.uint8)))
    await asyncio.sleep(0)
    await grid.close()
    assert asyncio.all_tasks() == {asyncio.current_task()}
