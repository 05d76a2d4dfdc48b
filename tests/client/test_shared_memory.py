"""Streams whose frames pass through memory that is shared with a service on the same host."""

from __future__ import annotations

import asyncio
import gc
import socket
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import unbend
from tests.client.conftest import Server
from unbend._memory import LENT_AT_MOST
from unbend_service.transport.local.listener import MemoryListener

WIDTH, HEIGHT = 64, 48


class LocalServer(Server):
    """A server that listens on a local socket too."""

    def __init__(self, path: Path, **changed: object) -> None:
        self.path = path
        super().__init__(**changed)
        self._listener = MemoryListener(path, self.service.regions, 8)
        self._thread.call(self._listener.start)

    def stop(self) -> None:
        if not self._stopped:
            self._thread.run(self._server.stop(0))  # as in the service: memory goes when nobody can ask for it any more
            self._thread.call(self._listener.close)
        super().stop()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "frames.sock"


@pytest.fixture
def server(path: Path) -> Iterator[LocalServer]:
    running = LocalServer(path)
    yield running
    assert_nothing_left(running)
    running.stop()


def assert_nothing_left(server: LocalServer) -> None:
    async def none() -> None:
        async with asyncio.timeout(5):
            while len(server.service.regions):  # noqa: ASYNC110 no event says so
                await asyncio.sleep(0.01)

    server._thread.run(none())


@pytest.fixture
def client(server: LocalServer) -> Iterator[unbend.Client]:
    with unbend.Client(server.target, timeout_s=10, shared_memory=server.path) as connected:
        yield connected


def pictures(count: int, shape: tuple[int, ...] = (HEIGHT, WIDTH)) -> list[np.ndarray]:
    random = np.random.default_rng(5)
    return [random.integers(0, 255, shape, np.uint8) for _ in range(count)]


@pytest.mark.parametrize(
    ("pixel_format", "shape"), [("gray8", (HEIGHT, WIDTH)), ("rgb24", (HEIGHT, WIDTH, 3)), ("i420", (72, WIDTH))]
)
def test_the_answers_are_those_that_the_connection_would_bring(
    server: LocalServer, client: unbend.Client, pixel_format: str, shape: tuple[int, ...]
) -> None:
    sent = pictures(30, shape)
    record = client.grids.put(unbend.Grid(np.stack(np.meshgrid(*[np.linspace(-0.9, 0.9, 9)] * 2), axis=-1)))
    with unbend.Client(server.target) as plain, plain.stream(WIDTH, HEIGHT, pixel_format, grid=record) as stream:
        expected = [result.image for result in stream.correct(sent)]
    with client.stream(WIDTH, HEIGHT, pixel_format, grid=record) as stream:
        assert len(server.service.regions) == 1
        for n, result in enumerate(stream.correct(sent)):
            assert result.index == n
            assert not result.image.flags.writeable
            np.testing.assert_array_equal(result.image, expected[n])


def test_an_answer_stays_as_it_is_for_as_long_as_it_is_held(client: unbend.Client) -> None:
    """However many answers are held, and however long after the stream: no later frame is drawn over them."""
    sent = pictures(5 * LENT_AT_MOST)
    with client.stream(WIDTH, HEIGHT, "gray8", in_flight=2) as stream:
        held, copies = [], []
        for result in stream.correct(sent):
            held.append(result.image)
            copies.append(result.image.copy())
    del stream
    gc.collect()
    for image, copy in zip(held, copies, strict=True):
        np.testing.assert_array_equal(image, copy)
    assert sum(image.base is not None and not image.flags.owndata for image in held) >= LENT_AT_MOST


def test_the_frame_may_be_drawn_over_once_the_next_one_is_asked_for(client: unbend.Client) -> None:
    def frames() -> Iterator[np.ndarray]:
        buffer = np.empty((HEIGHT, WIDTH), np.uint8)
        for level in range(20):
            buffer[:] = level
            yield buffer

    with client.stream(WIDTH, HEIGHT, "gray8") as stream:
        assert [int(result.image.flat[0]) for result in stream.correct(frames())] == list(range(20))


def test_frames_that_pass_through_or_fail_or_are_dropped_free_their_places(
    server: LocalServer, client: unbend.Client
) -> None:
    server.service.estimation._estimator.confidence = 0.0
    sent = pictures(40)
    with client.stream(WIDTH, HEIGHT, "gray8", min_confidence=0.5, delivery="latest", in_flight=3) as stream:
        for n, result in enumerate(stream.correct(sent)):
            if result.status is unbend.FrameStatus.PASSED_THROUGH:
                np.testing.assert_array_equal(result.image, sent[n])
    server.pool.failure = None


def test_an_iteration_that_was_given_up_leaves_the_stream_usable(client: unbend.Client) -> None:
    with client.stream(WIDTH, HEIGHT, "gray8") as stream:
        for _ in range(4):
            for _result in stream.correct(pictures(20)):
                break
        results = list(stream.correct(np.full((HEIGHT, WIDTH), n, np.uint8) for n in range(12)))
    assert [int(result.image.flat[0]) for result in results] == list(range(12))


def test_a_broken_stream_goes_on_in_new_memory(path: Path) -> None:
    """The service is started again on the same addresses: each frame is answered once all the same."""
    first = LocalServer(path)
    servers = [first]

    def frames() -> Iterator[np.ndarray]:
        for n in range(40):
            if n == 20:
                servers[0].stop()
                servers.append(LocalServer(path, port=first.port))
            yield np.full((HEIGHT, WIDTH), n, np.uint8)

    try:
        with (
            unbend.Client(first.target, timeout_s=20, shared_memory=str(path)) as client,
            client.stream(WIDTH, HEIGHT, "gray8") as stream,
        ):
            results = list(stream.correct(frames()))
    finally:
        assert_nothing_left(servers[-1])
        servers[-1].stop()
    assert [int(result.image.flat[0]) for result in results] == list(range(40))


async def test_the_asynchronous_face_does_the_same(server: LocalServer) -> None:
    async with (
        unbend.AsyncClient(server.target, timeout_s=10, shared_memory=server.path) as client,
        client.stream(WIDTH, HEIGHT, "gray8") as stream,
    ):
        assert len(server.service.regions) == 1
        sent = [np.full((HEIGHT, WIDTH), n, np.uint8) for n in range(30)]
        assert [int(result.image.flat[0]) async for result in stream.correct(sent)] == list(range(30))


def test_files_travel_over_the_connection(server: LocalServer, client: unbend.Client, picture: np.ndarray) -> None:
    import cv2

    body = cv2.imencode(".png", picture)[1].tobytes()
    with client.stream(pixel_format="png") as stream:
        assert len(server.service.regions) == 0
        (result,) = stream.correct([body])
    assert isinstance(result.image, bytes)


def test_more_memory_than_is_allowed_is_refused_with_the_setting(path: Path) -> None:
    server = LocalServer(path, local_memory_bytes=1 << 20)
    try:
        with (
            unbend.Client(server.target, timeout_s=5, shared_memory=path) as client,
            pytest.raises(unbend.InvalidRegion, match="local_memory_bytes"),
            client.stream(1920, 1080, "i420"),
        ):
            pass
    finally:
        server.stop()


def test_without_a_service_behind_the_socket_it_is_unreachable(tmp_path: Path, server: LocalServer) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as nobody:
        nobody.bind(str(tmp_path / "old.sock"))
    with (
        unbend.Client(server.target, timeout_s=5, shared_memory=tmp_path / "old.sock") as client,
        pytest.raises(unbend.Unreachable, match=r"old\.sock"),
        client.stream(WIDTH, HEIGHT, "gray8"),
    ):
        pass
