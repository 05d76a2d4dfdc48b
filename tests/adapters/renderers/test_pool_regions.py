"""Frames in the memory of clients, with real worker processes."""

from __future__ import annotations

import asyncio
import fcntl
import os
from pathlib import Path

import numpy as np
import pytest

from tests.adapters.renderers import misbehaving
from tests.adapters.renderers.conftest import MakePool, until, worker_processes
from tests.adapters.renderers.test_pool import GRID, expected, frame
from unbend_service.adapters.renderers.pool import WorkerPool
from unbend_service.application.ports import SharedPicture
from unbend_service.application.regions import Regions
from unbend_service.domain.errors import DeadlineExceeded, RegionNotFound, RenderFailed
from unbend_service.domain.frames import BLACK, Frame

NAME = "unbend-test-region"


class Client:
    """Memory of a client that holds ``count`` frames and their answers."""

    def __init__(self, pool: WorkerPool, like: Frame, count: int = 1) -> None:
        self.size = like.data.size
        fd = os.memfd_create(NAME, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        os.ftruncate(fd, 2 * count * self.size)
        fcntl.fcntl(fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)
        self.regions = Regions(pool, 1 << 30)
        self.region_id = self.regions.register(fd, 2 * count * self.size)
        self.like, self.pool = like, pool

    def put(self, source: Frame, n: int = 0) -> tuple[Frame, SharedPicture]:
        picture = self.regions.picture(self.region_id, 2 * n * self.size, (2 * n + 1) * self.size, self.size, self.size)
        first = picture.source_offset
        picture.memory.memory[first : first + self.size] = source.data
        return Frame(source.pixel_format, source.width, source.height, picture.source), picture

    async def render(self, source: Frame, n: int = 0, deadline_s: float | None = None) -> np.ndarray:
        lying, picture = self.put(source, n)
        return await self.pool.render(lying, GRID, BLACK, shared=picture, deadline_s=deadline_s)

    def go(self) -> None:
        self.regions.release(self.region_id)


def mappings(pid: int | str) -> int:
    """How often a process has memory of clients mapped or open."""
    lines = Path(f"/proc/{pid}/maps").read_text().splitlines()
    names = [os.readlink(entry) for entry in Path(f"/proc/{pid}/fd").iterdir() if entry.is_symlink()]
    return sum(NAME in line for line in (*lines, *names))


async def test_frames_are_drawn_where_they_lie(make_pool: MakePool) -> None:
    """The answers stand in the client's memory, the same as those of frames that were copied, and no slot is lent."""
    pool = await make_pool(workers=2)
    sources = [frame(misbehaving.DRAW, seed) for seed in range(12)]
    client = Client(pool, sources[0], len(sources))
    answers = await asyncio.gather(*(client.render(source, n) for n, source in enumerate(sources)))
    for n, (source, answer) in enumerate(zip(sources, answers, strict=True)):
        np.testing.assert_array_equal(answer, expected(source))
        assert np.shares_memory(answer, client.put(source, n)[1].target)
    assert pool._lending.lent_bytes == 0
    client.go()


async def test_the_death_of_a_worker_costs_no_frame(make_pool: MakePool) -> None:
    pool = await make_pool()
    source = frame(misbehaving.KILLED_TWICE)
    client = Client(pool, source)
    np.testing.assert_array_equal(await client.render(source), expected(source))
    client.go()


async def test_when_the_client_goes_its_memory_is_gone_from_every_process(make_pool: MakePool) -> None:
    """Also in the middle of a frame, which is finished first; afterwards nothing is drawn there."""
    pool = await make_pool(workers=2)
    source = frame(misbehaving.SLEEP)
    client = Client(pool, source)
    lying, picture = client.put(source)
    rendering = asyncio.create_task(pool.render(lying, GRID, BLACK, shared=picture))
    await asyncio.sleep(0.1)
    client.go()
    await rendering
    with pytest.raises(RegionNotFound):
        await pool.render(lying, GRID, BLACK, shared=picture)
    del lying, picture, rendering
    await until(lambda: not any(mappings(process.pid) for process in worker_processes()))
    await until(lambda: not mappings("self"))


async def test_nobody_draws_in_the_memory_after_a_frame_was_given_up(make_pool: MakePool) -> None:
    """The deadline is told only once the worker is done with the frame: its places may be used for another."""
    pool = await make_pool()
    source = frame(misbehaving.SLEEP)
    client = Client(pool, source)
    with pytest.raises(DeadlineExceeded):
        await client.render(source, deadline_s=0.1)
    _, picture = client.put(frame(misbehaving.DRAW, 9))
    picture.target[:] = 1
    await asyncio.sleep(2 * misbehaving.SLEEP_S)
    assert (picture.target == 1).all()
    with pytest.raises(RenderFailed):
        await client.render(frame(misbehaving.RAISE))
    client.go()
