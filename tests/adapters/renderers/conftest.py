from __future__ import annotations

import asyncio
import gc
import os
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import psutil
import pytest

from tests.fakes import RecordingMeter
from unbend_service.adapters.renderers.pool import WorkerPool
from unbend_service.settings import Settings

MakePool = Callable[..., Awaitable[WorkerPool]]


def worker_processes() -> list[psutil.Process]:
    """Render workers that live."""
    return [
        child
        for child in psutil.Process().children()
        if child.status() != psutil.STATUS_ZOMBIE and any("renderers.worker" in part for part in child.cmdline())
    ]


def slot_descriptors() -> int:
    """Descriptors of shared memory for frames that this process holds."""
    gc.collect()  # an error and the frames of its traceback may hold answers in a circle
    links = []
    for name in os.listdir("/proc/self/fd"):
        try:
            links.append(os.readlink(f"/proc/self/fd/{name}"))
        except FileNotFoundError:
            continue  # the listing's own descriptor
    return sum("unbend-slot" in link for link in links)


@pytest.fixture
def meter() -> RecordingMeter:
    return RecordingMeter()


@pytest.fixture
async def make_pool(meter: RecordingMeter, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> AsyncIterator[MakePool]:
    """Starts pools of misbehaving renderers with these settings; closes them after the test and sees that they went."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)
    monkeypatch.setenv("UNBEND_TEST_MARK", str(tmp_path / "mark"))
    pools: list[WorkerPool] = []

    async def make(factory: str = "open_misbehaving", **settings: object) -> WorkerPool:
        values = {"workers": 1, "renderer": "cpu", **settings}
        pool = WorkerPool(Settings(**values), meter, renderer_factory=f"misbehaving:{factory}")
        pools.append(pool)
        await pool.start()
        await until(lambda: all(worker.state == "ready" for worker in pool.state().workers))
        return pool

    yield make
    for pool in pools:
        await pool.close(0)
    assert worker_processes() == []
    assert slot_descriptors() == 0


async def until(condition: Callable[[], bool], patience_s: float = 20.0) -> None:
    """Waits for ``condition``; fails after ``patience_s``."""
    end = time.monotonic() + patience_s
    while not condition():
        if time.monotonic() > end:
            pytest.fail("it did not come true in time")
        await asyncio.sleep(0.01)
