# ruff: noqa: ASYNC240 (a look at a temporary folder holds up nobody)
"""The local socket as any client may use or misuse it."""

from __future__ import annotations

import asyncio
import fcntl
import os
import socket
import stat
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from tests.fakes import FakeRenderPool
from unbend.v1 import memory_pb2
from unbend_service.application.regions import Regions
from unbend_service.domain.errors import InvalidOption
from unbend_service.transport.local.listener import MemoryListener

SIZE = 1 << 16
Response = memory_pb2.RegisterRegionResponse


@pytest.fixture
def path(tmp_path: Path) -> Path:
    tmp_path.chmod(0o700)
    return tmp_path / "frames.sock"


@pytest.fixture
def regions() -> Regions:
    return Regions(FakeRenderPool(), 2 * SIZE)


@pytest.fixture
async def listener(path: Path, regions: Regions) -> AsyncIterator[MemoryListener]:
    listening = MemoryListener(path, regions, connections=3)
    listening.start()
    yield listening
    listening.close()
    assert not path.exists()
    assert len(regions) == 0


def memfd(seals: int = fcntl.F_SEAL_SHRINK) -> int:
    fd = os.memfd_create("unbend-test-region", os.MFD_ALLOW_SEALING)
    os.ftruncate(fd, SIZE)
    fcntl.fcntl(fd, fcntl.F_ADD_SEALS, seals)
    return fd


def connect(path: Path) -> socket.socket:
    end = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    end.settimeout(5)
    end.connect(str(path))
    return end


def ask(end: socket.socket, body: bytes, fds: list[int]) -> Response:
    socket.send_fds(end, [body], fds)
    for fd in fds:
        os.close(fd)
    return Response.FromString(end.recv(4096))


async def register(end: socket.socket, fds: list[int] | None = None, size_bytes: int = SIZE) -> Response:
    body = memory_pb2.RegisterRegionRequest(size_bytes=size_bytes).SerializeToString()
    return await asyncio.to_thread(ask, end, body, [memfd()] if fds is None else fds)


async def until_empty(regions: Regions) -> None:
    async with asyncio.timeout(5):
        while len(regions):  # noqa: ASYNC110 no event says so
            await asyncio.sleep(0.01)


def descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))


async def test_a_region_lives_as_long_as_its_connection(listener: MemoryListener, path: Path, regions: Regions) -> None:
    before = descriptors()
    end = connect(path)
    answer = await register(end)
    regions.picture(answer.region_id, 0, 100, 100, 100)
    end.close()
    await until_empty(regions)
    assert descriptors() == before


async def test_only_this_user_may_connect(listener: MemoryListener, path: Path) -> None:
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


@pytest.mark.parametrize(
    ("seals", "count", "size_bytes", "code"),
    [
        (fcntl.F_SEAL_GROW, 1, SIZE, "invalid_region"),
        (fcntl.F_SEAL_SHRINK, 0, SIZE, "invalid_region"),
        (fcntl.F_SEAL_SHRINK, 2, SIZE, "invalid_region"),
        (fcntl.F_SEAL_SHRINK, 9, SIZE, "invalid_region"),
        (fcntl.F_SEAL_SHRINK, 1, 0, "invalid_region"),
        (fcntl.F_SEAL_SHRINK, 1, SIZE + 1, "invalid_region"),
        (fcntl.F_SEAL_SHRINK, 1, 2**63, "invalid_region"),
    ],
)
async def test_what_cannot_be_shared_is_refused_by_name_and_the_connection_goes_on(
    listener: MemoryListener, path: Path, regions: Regions, seals: int, count: int, size_bytes: int, code: str
) -> None:
    before = descriptors()
    with connect(path) as end:
        answer = await register(end, [memfd(seals) for _ in range(count)], size_bytes)
        assert answer.error.code == code
        assert answer.error.message
        assert len(regions) == 0
        assert descriptors() == before + 2  # both ends of the connection, no descriptor that came over it
        assert (await register(end)).region_id


async def test_a_packet_that_is_no_request_is_refused(listener: MemoryListener, path: Path) -> None:
    with connect(path) as end:
        answer = await asyncio.to_thread(ask, end, b"\xff\xff\xff", [memfd()])
        assert answer.error.code == "invalid_region"


async def test_memory_and_connections_are_bounded(listener: MemoryListener, path: Path) -> None:
    ends = [connect(path) for _ in range(3)]
    first, second, third = [await register(end) for end in ends]
    assert first.region_id
    assert second.region_id
    assert (third.error.code, third.error.setting) == ("too_many_regions", "local_memory_bytes")
    with connect(path) as fourth:
        turned_away = Response.FromString(await asyncio.to_thread(fourth.recv, 4096))
        assert turned_away.error.code == "too_many_regions"
        assert await asyncio.to_thread(fourth.recv, 4096) == b""
    for end in ends:
        end.close()


async def test_the_socket_of_a_process_that_crashed_is_replaced(path: Path, regions: Regions) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as crashed:
        crashed.bind(str(path))
    listener = MemoryListener(path, regions, 3)
    listener.start()
    with connect(path) as end:
        assert (await register(end)).region_id
    await until_empty(regions)
    listener.close()


async def test_the_socket_of_a_living_process_is_left_to_it(
    listener: MemoryListener, path: Path, regions: Regions
) -> None:
    second = MemoryListener(path, regions, 3)
    with pytest.raises(OSError, match="Cannot listen"):
        second.start()
    second.close()
    assert path.exists()


async def test_a_folder_in_which_others_could_replace_the_socket_is_refused(path: Path, regions: Regions) -> None:
    path.parent.chmod(0o777)
    with pytest.raises(InvalidOption, match="local_socket"):
        MemoryListener(path, regions, 3).start()
    path.parent.chmod(0o1777)
    listener = MemoryListener(path, regions, 3)
    listener.start()
    listener.close()


async def test_no_file_is_removed_for_the_socket(path: Path, regions: Regions) -> None:
    path.write_text("mine")
    with pytest.raises(InvalidOption, match="not a socket"):
        MemoryListener(path, regions, 3).start()
    assert path.read_text() == "mine"
    with pytest.raises(InvalidOption, match="cannot be read"):
        MemoryListener(path.parent / "nowhere" / "frames.sock", regions, 3).start()
