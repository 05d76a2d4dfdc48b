"""A real service and clients of the same host that share memory with it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import unbend
from tests.acceptance.conftest import Server, shared_memory_names, start_server, stop_server
from tests.acceptance.test_endings import eventually

WIDTH, HEIGHT = 640, 360
SHAPE = (HEIGHT * 3 // 2, WIDTH)
ENDLESS = f"""
import itertools, sys, numpy as np, unbend
with unbend.Client(sys.argv[1], shared_memory=sys.argv[2]) as client:
    with client.stream({WIDTH}, {HEIGHT}, "i420") as stream:
        frame = np.zeros({SHAPE}, np.uint8)
        for result in stream.correct(itertools.repeat(frame)):
            if result.index == 20:
                print("going", flush=True)
"""


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Server, Path]]:
    path = tmp_path_factory.mktemp("local") / "frames.sock"
    server = start_server(local_socket=str(path), renderer="cpu", workers="2")
    yield server, path
    assert stop_server(server) == 0
    assert not path.exists()


def shared_memories(server: Server) -> int:
    """Descriptors and mappings of clients' memory, over all processes of the service."""
    count = 0
    for pid in (server.process.pid, *(worker.pid for worker in server.workers())):
        links = [os.readlink(entry) for entry in Path(f"/proc/{pid}/fd").iterdir() if entry.is_symlink()]
        maps = Path(f"/proc/{pid}/maps").read_text().splitlines()
        count += sum("unbend-frames" in line for line in (*links, *maps))
    return count


def until_none(server: Server) -> None:
    end = time.monotonic() + 10
    while count := shared_memories(server):
        assert time.monotonic() < end, f"{count} are left"
        time.sleep(0.05)


def test_frames_through_shared_memory_are_those_of_the_connection(local: tuple[Server, Path]) -> None:
    server, path = local
    frames = [np.random.default_rng(seed).integers(0, 255, SHAPE, np.uint8) for seed in range(6)]
    points = np.linspace(-0.95, 0.95, 17)
    lens = np.stack(np.meshgrid(points, points), axis=-1) * (
        1 - 0.1 * np.hypot(*np.meshgrid(points, points))[..., None]
    )
    with unbend.Client(server.grpc) as plain, unbend.Client(server.grpc, shared_memory=path) as sharing:
        record = plain.grids.put(unbend.Grid(lens))
        images = []
        for client in (plain, sharing):
            with client.stream(WIDTH, HEIGHT, "i420", grid=record) as stream:
                images.append([result.image for result in stream.correct(frames)])
    for one, other in zip(*images, strict=True):
        np.testing.assert_array_equal(one, other)
    until_none(server)


@pytest.mark.parametrize("sharing", [False, True], ids=["sent", "shared"])
def test_frames_that_cannot_be_done_in_time_fail_and_leave_the_others_alone(
    local: tuple[Server, Path], sharing: bool
) -> None:
    """A 1080p frame is not drawn within a millisecond; where its answer would have been, nobody draws any more."""
    server, path = local
    frames = [np.full((1620, 1920), level, np.uint8) for level in range(100, 112)]
    points = np.linspace(-0.9, 0.9, 9)
    lens = unbend.Grid(np.stack(np.meshgrid(points, points), axis=-1))
    with unbend.Client(server.grpc, shared_memory=path if sharing else None) as client:
        record = client.grids.put(lens)
        for seconds, status in ((0.001, "failed"), (60.0, "corrected"), (None, "corrected")):
            with client.stream(1920, 1080, "i420", grid=record, fit="keep", frame_deadline_s=seconds) as stream:
                results = [(r.index, str(r.status), r.error, r.image) for r in stream.correct(frames)]
            assert [result[:2] for result in results] == [(index, status) for index in range(12)]
            for (_, _, error, image), frame in zip(results, frames, strict=True):
                if status == "failed":
                    assert isinstance(error, unbend.DeadlineExceeded)
                else:
                    np.testing.assert_array_equal(image, frame)


def test_of_a_client_that_is_killed_nothing_is_left(local: tuple[Server, Path]) -> None:
    """No descriptor, no mapping, nothing in /dev/shm; the service goes on."""
    server, path = local
    before = shared_memory_names()
    with subprocess.Popen(
        [sys.executable, "-c", ENDLESS, server.grpc, str(path)], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "going\n"
        assert shared_memories(server)
        process.send_signal(signal.SIGKILL)
    until_none(server)
    assert eventually(lambda: shared_memory_names() <= before)
    with unbend.Client(server.grpc, shared_memory=path) as client, client.stream(WIDTH, HEIGHT, "i420") as stream:
        assert len(list(stream.correct([np.zeros(SHAPE, np.uint8)] * 10))) == 10
