from __future__ import annotations

import asyncio
from collections import Counter

import numpy as np
import pytest

from unbend_service.adapters.renderers.jobs import Job, JobQueue, preferred_worker
from unbend_service.domain.frames import BLACK, Frame, PixelFormat
from unbend_service.domain.grid import Grid


def queue_of(*preferred: int) -> tuple[JobQueue, list[Job]]:
    frame = Frame(PixelFormat.GRAY8, 3, 1, np.zeros(3, np.uint8))
    loop = asyncio.get_running_loop()
    jobs = [
        Job(number, frame, Grid.identity(), BLACK, None, worker, 0.0, loop.create_future())
        for number, worker in enumerate(preferred)
    ]
    queue = JobQueue()
    for job in jobs:
        queue.append(job)
    return queue, jobs


def test_streams_spread_evenly_and_move_little() -> None:
    """Every worker is preferred by its share of the streams, and one worker more moves only its own share."""
    keys = [f"stream-{n}" for n in range(600)]
    shares = Counter(preferred_worker(key, 4) for key in keys)
    assert sorted(shares) == [0, 1, 2, 3]
    assert min(shares.values()) > 100
    moved = [key for key in keys if preferred_worker(key, 4) != preferred_worker(key, 5)]
    assert all(preferred_worker(key, 5) == 4 for key in moved)
    assert preferred_worker(None, 4) == -1


async def test_a_worker_takes_the_frame_that_suits_it() -> None:
    """A frame of its own stream, a little further back, goes before one of another."""
    queue, jobs = queue_of(0, 1)
    assert queue.pick({1}, 2) == (jobs[1], 1)
    assert queue.pick({0, 1}, 2) == (jobs[0], 0)


async def test_a_frame_that_suits_nobody_is_not_passed_over_for_ever() -> None:
    """The first frame is taken at last, whoever is free."""
    queue, jobs = queue_of(0, 1, 1, 1, 1)
    taken = []
    for _ in range(3):
        job, _ = queue.pick({1}, 2)
        taken.append(job)
        queue.remove(job)
    assert taken == [jobs[1], jobs[2], jobs[0]]


async def test_frames_without_affinity_keep_their_order() -> None:
    """First in, first out; a frame whose worker died goes first again."""
    queue, jobs = queue_of(-1, -1)
    assert queue.pick({0, 1}, 2) == (jobs[0], None)
    assert queue.remove(jobs[0])
    assert not queue.remove(jobs[0])
    queue.put_first(jobs[0])
    assert list(queue) == jobs


async def test_an_empty_queue_has_nothing_to_pick() -> None:
    """Asking it is a mistake of the caller."""
    with pytest.raises(IndexError):
        JobQueue().pick({0}, 1)


async def test_the_lattice_lies_aligned_behind_both_pictures() -> None:
    """A slot holds source, target and lattice without overlap, the lattice where float32 may lie."""
    _, (job,) = queue_of(-1)
    assert job.lattice_offset == 8
    assert job.slot_bytes == 8 + 65 * 65 * 2 * 4


async def test_a_greedy_stream_does_not_starve_the_others() -> None:
    """However many frames one stream has waiting, the next frame of another is behind one of them at most."""
    loop = asyncio.get_running_loop()
    queue = JobQueue()

    def put(number: int, flow: str | None, size_px: int = 100) -> None:
        frame = Frame(PixelFormat.GRAY8, size_px, 1, np.zeros(size_px, np.uint8))
        queue.append(Job(number, frame, Grid.identity(), BLACK, flow, -1, 0.0, loop.create_future()))

    def take() -> str | None:
        job, _ = queue.pick({0}, 1)
        queue.remove(job)
        return job.flow

    for number in range(8):
        put(number, "greedy")
    assert [take(), take()] == ["greedy"] * 2
    put(8, "modest")
    put(9, None)
    assert sorted(str(take()) for _ in range(3)) == ["None", "greedy", "modest"]
    for number in range(10, 13):
        put(number, "modest")
    put(13, "large", size_px=300)
    order = [str(take()) for _ in range(len(queue))]
    assert [sorted(order[:3]), sorted(order[3:5])] == [["greedy", "large", "modest"], ["greedy", "modest"]]
    assert order[7:] == ["greedy"] * len(order[7:])
