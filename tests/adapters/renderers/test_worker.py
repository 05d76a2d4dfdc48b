"""A worker process on its own: how it ends, and what it lets through."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import threading

import numpy as np
import psutil
import pytest

from tests.adapters.renderers import misbehaving
from tests.adapters.renderers.conftest import MakePool, until
from unbend_service.adapters.renderers import worker as worker_module
from unbend_service.adapters.renderers.channel import Channel
from unbend_service.adapters.renderers.cpu import CpuRenderer
from unbend_service.adapters.renderers.worker import Worker
from unbend_service.domain.frames import BLACK, Frame, PixelFormat
from unbend_service.domain.grid import Grid

_PARENT = """
import asyncio, os, signal, sys
from tests.fakes import RecordingMeter
from unbend_service.adapters.renderers.pool import WorkerPool
from unbend_service.settings import Settings

async def main():
    pool = WorkerPool(Settings(renderer="cpu", workers=2), RecordingMeter())
    await pool.start()
    print(*(worker.pid for worker in pool.state().workers), file=sys.stderr, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)

asyncio.run(main())
"""


async def test_workers_end_with_their_parent() -> None:
    """A service that is killed leaves no process behind."""
    ended = await asyncio.to_thread(
        subprocess.run, [sys.executable, "-c", _PARENT], capture_output=True, text=True, check=False, timeout=60
    )
    assert ended.returncode == -signal.SIGKILL
    pids = [int(pid) for pid in ended.stderr.split()]
    assert len(pids) == 2, ended.stderr
    await until(lambda: not any(is_alive(pid) for pid in pids))


def is_alive(pid: int) -> bool:
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


async def test_signals_to_stop_are_left_to_the_parent(make_pool: MakePool) -> None:
    """A worker finishes what it has while the service drains, and does not sit in the terminal's process group."""
    pool = await make_pool()
    pid = pool.state().workers[0].pid
    assert pid is not None
    assert os.getpgid(pid) != os.getpgid(0)
    data = np.zeros(600, np.uint8)
    data[0] = misbehaving.SLEEP
    answer = asyncio.create_task(pool.render(Frame(PixelFormat.RGB24, 20, 10, data), Grid.identity(), BLACK))
    await asyncio.sleep(0.1)
    os.kill(pid, signal.SIGTERM)
    os.kill(pid, signal.SIGINT)
    assert len(await answer) == 600
    assert pool.state().workers[0].pid == pid


async def test_a_worker_is_known_by_its_name(make_pool: MakePool) -> None:
    """Whoever looks at the process list sees which process renders."""
    pool = await make_pool(workers=2)
    names = {psutil.Process(worker.pid).name() for worker in pool.state().workers}
    assert names == {"unbend-render0", "unbend-render1"}


async def test_descriptors_do_not_pile_up(make_pool: MakePool) -> None:
    """Frames of ever other sizes leave neither descriptors nor maps behind, on either side."""
    pool = await make_pool(shared_memory_bytes=2 << 20)
    worker = psutil.Process(pool.state().workers[0].pid)
    for n in range(200):
        width = 100 + 37 * (n * n % 23)
        data = np.zeros(width * 90 * 4, np.uint8)
        await pool.render(Frame(PixelFormat.RGBA, width, 90, data), Grid.identity(), BLACK)
    assert worker.num_fds() < 40
    assert psutil.Process().num_fds() < 100
    mapped = sum("unbend-slot" in entry.path for entry in worker.memory_maps())
    assert 0 < mapped < 30


def test_a_worker_without_work_gives_memory_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is kept only for a next frame of the same size is not kept for hours."""
    renderer, rested = CpuRenderer(), threading.Event()
    rgb = Frame(PixelFormat.RGB24, 640, 480, np.zeros(640 * 480 * 3, np.uint8))
    renderer.render(rgb, Grid.identity(), BLACK, np.empty_like(rgb.data))
    kept_bytes = renderer.kept_bytes
    assert renderer._wide is not None
    monkeypatch.setattr(worker_module, "REST_S", 0.01)
    monkeypatch.setattr(worker_module, "give_back", rested.set)
    ours, theirs = Channel.pair()

    def serve() -> None:
        with pytest.raises(EOFError):
            Worker(theirs, renderer).serve()

    serving = threading.Thread(target=serve)
    serving.start()
    assert rested.wait(10)
    ours.close()
    serving.join(10)
    assert not serving.is_alive()
    assert renderer._wide is None
    assert renderer.kept_bytes == kept_bytes > 0
    theirs.close()
