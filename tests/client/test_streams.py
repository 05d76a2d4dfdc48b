"""Streams of both faces, against real servers over fakes, through a wire that can be cut."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import AsyncIterator, Iterator

import cv2
import numpy as np
import pytest

import unbend
from tests.client.conftest import Server, Wire
from unbend_service.adapters.grid_stores.memory import MemoryGridStore
from unbend_service.domain.errors import PoisonFrame
from unbend_service.settings import Settings

WIDTH, HEIGHT = 64, 48


def gray(index: int) -> np.ndarray:
    return np.full((HEIGHT, WIDTH), index % 256, np.uint8)


def grays(count: int) -> Iterator[tuple[np.ndarray, int]]:
    return ((gray(index), index * 40_000) for index in range(count))


def shown(results: list[unbend.StreamResult]) -> list[int]:
    """Which frame each answer shows: the frames are flat, and crop shows no border."""
    return [int(result.image.flat[0]) for result in results]


def threads() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name == "unbend-stream"]


def test_every_frame_is_answered_once_in_order_with_its_timestamp(server: Server, client: unbend.Client) -> None:
    with client.stream(WIDTH, HEIGHT, "gray8") as stream:
        results = list(stream.correct(grays(100)))

    assert [(r.index, r.timestamp_us) for r in results] == [(i, i * 40_000) for i in range(100)]
    assert shown(results) == list(range(100))
    assert {r.status for r in results} == {unbend.FrameStatus.CORRECTED}
    assert all(r.image.shape == (HEIGHT, WIDTH) for r in results)
    assert stream.grid is not None
    assert client.grids.get(stream.grid.grid_id).grid_id == stream.grid.grid_id
    assert server.meter.estimates == {"corrected": 1}
    assert server.meter.requests[0] == ("grpc", "CorrectionService/CorrectStream", "OK")
    assert threads() == []


@pytest.mark.parametrize(
    ("pixel_format", "shape"),
    [
        ("rgb24", (HEIGHT, WIDTH, 3)),
        ("bgra", (HEIGHT, WIDTH, 4)),
        ("i420", (HEIGHT * 3 // 2, WIDTH)),
        ("nv12", (HEIGHT * 3 // 2, WIDTH)),
        ("i420", (HEIGHT * WIDTH * 3 // 2,)),
        ("gray8", (HEIGHT, WIDTH, 1)),
    ],
)
def test_answers_have_the_shape_of_the_frames(client: unbend.Client, pixel_format: str, shape: tuple[int, ...]) -> None:
    with client.stream(WIDTH, HEIGHT, pixel_format) as stream:
        results = list(stream.correct([np.zeros(shape, np.uint8)] * 3))

    assert [r.image.shape for r in results] == [shape] * 3


def test_raw_bytes_come_back_as_bytes_also_of_odd_sizes(client: unbend.Client) -> None:
    with client.stream(5, 3, "i420") as stream:
        results = list(stream.correct([bytes(15 + 2 * 6)] * 2))

    assert [len(r.image) for r in results] == [27, 27]
    assert all(isinstance(r.image, bytes) for r in results)


def test_files_come_back_as_files_and_a_broken_one_fails_alone(client: unbend.Client, picture: np.ndarray) -> None:
    body = cv2.imencode(".jpg", picture)[1].tobytes()
    with client.stream(pixel_format="jpeg") as stream:
        results = list(stream.correct([body, body[:100], body]))

    assert [r.status for r in results] == ["corrected", "failed", "corrected"]
    assert isinstance(results[1].error, unbend.InvalidImage)
    assert results[1].image is None
    assert results[2].image.startswith(b"\xff\xd8")


def test_a_short_clip_does_not_wait_for_frames_that_will_not_come() -> None:
    server = Server(stream_estimate_wait_s=8)
    with unbend.Client(server.target) as client, client.stream(WIDTH, HEIGHT, "gray8", frames=64) as stream:
        start = time.monotonic()
        first = list(stream.correct(grays(1)))
        took_s = time.monotonic() - start
        second = list(stream.correct(grays(1)))
    server.stop()

    assert took_s < 4
    assert [r.index for r in first + second] == [0, 1]
    assert stream.resumed


def test_a_stream_is_resumed_by_its_id_with_the_same_grid_and_no_second_estimate(
    server: Server, client: unbend.Client
) -> None:
    grid_ids = []
    for _ in range(2):
        with client.stream(WIDTH, HEIGHT, "gray8", stream_id="camera-7") as stream:
            _ = list(stream.correct(grays(10)))
            assert stream.grid is not None
            grid_ids.append(stream.grid.grid_id)
    assert stream.resumed
    assert grid_ids[0] == grid_ids[1]
    assert server.meter.estimates == {"corrected": 1}


def test_an_iteration_that_is_given_up_can_be_followed_by_another(server: Server, client: unbend.Client) -> None:
    with client.stream(WIDTH, HEIGHT, "gray8") as stream:
        for result in stream.correct(grays(50)):
            if result.index == 10:
                break
        later = list(stream.correct([gray(200), gray(201)]))

    assert shown(later) == [200, 201]
    assert server.meter.estimates == {"corrected": 1}


def test_a_wire_that_is_cut_again_and_again_costs_no_frame(server: Server) -> None:
    wire = Wire(server.port)
    results = []
    with unbend.Client(wire.target) as client, client.stream(WIDTH, HEIGHT, "gray8") as stream:
        for result in stream.correct(grays(200)):
            results.append(result)
            if result.index % 40 == 7:
                wire.cut()
    wire.close()

    assert [r.index for r in results] == list(range(200))
    assert shown(results) == list(range(200))
    assert server.meter.estimates == {"corrected": 1}
    assert wire.connections >= 5


def test_a_server_that_dies_in_mid_stream_is_replaced_by_a_replica_with_the_same_grid() -> None:
    store = MemoryGridStore(Settings())
    first = Server(store)
    servers = [first]
    results = []
    with unbend.Client(first.target) as client, client.stream(WIDTH, HEIGHT, "gray8") as stream:
        for result in stream.correct(grays(60)):
            results.append(result)
            if result.index == 20:
                before = stream.grid
                first.stop()
                servers.append(Server(store, port=first.port))
    for server in servers:
        server.stop()

    assert shown(results) == list(range(60))
    assert before is not None
    assert stream.grid is not None
    assert stream.grid.grid_id == before.grid_id
    assert servers[1].meter.estimates == {}


def test_a_server_that_drains_hands_the_stream_over() -> None:
    store = MemoryGridStore(Settings())
    first = Server(store)
    servers = [first]
    results = []
    with unbend.Client(first.target) as client, client.stream(WIDTH, HEIGHT, "gray8") as stream:
        for result in stream.correct(grays(60)):
            results.append(result)
            if result.index == 20:
                first.drain()
                first.stop()
                servers.append(Server(store, port=first.port))
    for server in servers:
        server.stop()

    assert shown(results) == list(range(60))
    assert first.meter.frames["failed"] == 0


def test_a_server_that_stays_away_is_an_error_in_the_end(server: Server) -> None:
    def run(stream: unbend.Stream) -> None:
        for result in stream.correct(grays(60)):
            if result.index == 20:
                server.stop()

    with (
        unbend.Client(server.target) as client,
        client.stream(WIDTH, HEIGHT, "gray8", reconnects=2) as stream,
        pytest.raises(unbend.Unreachable),
    ):
        run(stream)


def test_a_stream_that_another_client_takes_over_says_so_and_does_not_take_it_back(server: Server) -> None:
    def two() -> Iterator[np.ndarray]:
        yield gray(0)
        with other.stream(WIDTH, HEIGHT, "gray8", stream_id="camera-7") as newer:
            answered.extend(newer.correct(grays(5)))
        yield gray(1)

    answered: list[unbend.StreamResult] = []
    with (
        unbend.Client(server.target) as client,
        unbend.Client(server.target) as other,
        client.stream(WIDTH, HEIGHT, "gray8", stream_id="camera-7") as older,
        pytest.raises(unbend.StreamTakenOver),
    ):
        _ = list(older.correct(two()))

    assert shown(answered) == list(range(5))


def test_a_stream_that_was_idle_goes_on(client: unbend.Client) -> None:
    server = Server(stream_idle_s=0.1)

    def hesitant() -> Iterator[np.ndarray]:
        for index in range(3):
            yield gray(index)
            time.sleep(0.4)

    with unbend.Client(server.target) as hasty, hasty.stream(WIDTH, HEIGHT, "gray8", frames=1) as stream:
        results = list(stream.correct(hesitant()))
    server.stop()

    assert shown(results) == [0, 1, 2]
    assert server.meter.estimates == {"corrected": 1}


def test_memory_stays_bounded_however_fast_the_frames_come(client: unbend.Client) -> None:
    drawn, answered = 0, 0

    def counted() -> Iterator[np.ndarray]:
        nonlocal drawn
        for index in range(50):
            assert drawn - answered <= 4
            drawn += 1
            yield gray(index)

    with client.stream(WIDTH, HEIGHT, "gray8", in_flight=4) as stream:
        for _ in stream.correct(counted()):
            answered += 1
    assert answered == 50


def test_latest_delivery_says_which_frames_were_dropped(client: unbend.Client) -> None:
    with client.stream(WIDTH, HEIGHT, "gray8", delivery="latest") as stream:
        results = list(stream.correct(grays(100)))

    assert [r.index for r in results] == list(range(100))
    assert {r.status for r in results} <= {unbend.FrameStatus.CORRECTED, unbend.FrameStatus.DROPPED}
    assert all((r.image is None) == (r.status == "dropped") for r in results)


def test_a_stream_may_use_a_grid_that_is_known(server: Server, client: unbend.Client, picture: np.ndarray) -> None:
    estimate = client.estimate(picture, correct="all")
    assert estimate.guides is not None
    found = []
    for grid in (estimate.grid_id, estimate, estimate.record, estimate.guides):
        with client.stream(WIDTH, HEIGHT, "gray8", grid=grid) as stream:
            _ = list(stream.correct(grays(2)))
            found.append(stream.grid.grid_id)

    assert set(found) == {estimate.grid_id}
    assert server.meter.estimates == {"corrected": 1}


def test_a_frame_that_kills_workers_fails_with_its_error(server: Server, client: unbend.Client) -> None:
    server.pool.failure = PoisonFrame("Two workers died.")
    with client.stream(WIDTH, HEIGHT, "gray8") as stream:
        results = list(stream.correct(grays(2)))

    assert [type(r.error) for r in results] == [unbend.PoisonFrame] * 2


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"pixel_format": "yuv999"}, unbend.UnsupportedPixelFormat),
        ({"pixel_format": "gray8", "width": None}, unbend.InvalidFrame),
        ({"pixel_format": "gray8", "width": 100_000, "height": 100_000}, unbend.TooManyPixels),
        ({"pixel_format": "gray8", "stream_id": "no spaces"}, unbend.InvalidOption),
        ({"pixel_format": "gray8", "grid": "gnone"}, unbend.GridNotFound),
        ({"pixel_format": "gray8", "grid": unbend.Grid(np.zeros((2, 2, 2)))}, unbend.InvalidOption),
        ({"pixel_format": "gray8", "grid": unbend.Guides((), ())}, unbend.InvalidGuides),
        ({"pixel_format": "gray8", "frames": 65}, unbend.InvalidOption),
        ({"pixel_format": "gray8", "delivery": "pigeon"}, unbend.InvalidOption),
        ({"pixel_format": "gray8", "while_estimating": "sleep"}, unbend.InvalidOption),
        ({"pixel_format": "gray8", "in_flight": 0}, unbend.InvalidOption),
        ({"pixel_format": "gray8", "frame_deadline_s": 0.0}, unbend.InvalidOption),
        ({"pixel_format": "gray8", "frame_deadline_s": float("nan")}, unbend.InvalidOption),
    ],
)
def test_a_stream_that_cannot_be_is_refused_when_it_is_opened(
    client: unbend.Client, options: dict[str, object], error: type[Exception]
) -> None:
    def enter() -> None:
        with client.stream(**{"width": WIDTH, "height": HEIGHT, **options}):
            pass

    with pytest.raises(error):
        enter()
    with client.stream(WIDTH, HEIGHT, "gray8") as stream:
        assert len(list(stream.correct(grays(2)))) == 2


@pytest.mark.parametrize(
    ("pixel_format", "frame"),
    [
        ("gray8", np.zeros((5, 5), np.uint8)),
        ("gray8", np.zeros((HEIGHT, WIDTH))),
        ("gray8", np.zeros((WIDTH, HEIGHT), np.uint8)),
        ("gray8", b"short"),
        ("jpeg", np.zeros((HEIGHT, WIDTH), np.uint8)),
    ],
)
def test_a_frame_of_the_wrong_layout_is_refused_before_it_is_sent(
    client: unbend.Client, pixel_format: str, frame: object
) -> None:
    with client.stream(WIDTH, HEIGHT, pixel_format) as stream, pytest.raises(unbend.InvalidFrame):
        _ = list(stream.correct([frame]))


def test_an_error_of_the_frames_themselves_reaches_the_caller(client: unbend.Client) -> None:
    def broken() -> Iterator[np.ndarray]:
        yield gray(0)
        raise KeyError("camera unplugged")

    with client.stream(WIDTH, HEIGHT, "gray8") as stream:
        with pytest.raises(KeyError):
            _ = list(stream.correct(broken()))
        assert shown(list(stream.correct([gray(9)]))) == [9]


def test_a_closed_stream_says_so(client: unbend.Client) -> None:
    stream = client.stream(WIDTH, HEIGHT, "gray8")
    with stream:
        pass
    with pytest.raises(unbend.Closed):
        _ = list(stream.correct(grays(1)))


def test_a_server_that_does_not_answer_is_a_timeout_error(server: Server) -> None:
    async def never(*_: object, **__: object) -> None:
        await asyncio.sleep(60)

    server.pool.render = never  # type: ignore[method-assign,assignment] # a worker that hangs
    with (
        unbend.Client(server.target, timeout_s=0.5) as client,
        client.stream(WIDTH, HEIGHT, "gray8") as stream,
        pytest.raises(TimeoutError),
    ):
        _ = list(stream.correct(grays(8)))


async def test_the_asynchronous_face_mends_a_cut_wire_too(server: Server) -> None:
    wire = Wire(server.port)
    results = []

    async def frames() -> AsyncIterator[tuple[np.ndarray, int]]:
        for item in grays(120):
            await asyncio.sleep(0)
            yield item

    async with (
        unbend.AsyncClient(wire.target) as client,
        client.stream(WIDTH, HEIGHT, "gray8", stream_id="camera-8") as stream,
    ):
        async for result in stream.correct(frames()):
            results.append(result)
            if result.index % 40 == 7:
                await asyncio.to_thread(wire.cut)
        more = [result async for result in stream.correct(grays(3))]
    await asyncio.to_thread(wire.close)

    assert [(r.index, r.timestamp_us) for r in results] == [(i, i * 40_000) for i in range(120)]
    assert shown(results) == list(range(120))
    assert shown(more) == [0, 1, 2]
    assert server.meter.estimates == {"corrected": 1}
    assert stream.stream_id == "camera-8"
    assert threads() == []


async def test_the_asynchronous_face_answers_while_the_next_frame_is_waited_for(server: Server) -> None:
    answered = asyncio.Event()

    async def hesitant() -> AsyncIterator[np.ndarray]:
        yield gray(0)
        await asyncio.wait_for(answered.wait(), 10)
        yield gray(1)

    async with (
        unbend.AsyncClient(server.target) as client,
        client.stream(WIDTH, HEIGHT, "gray8", frames=1) as stream,
    ):
        async for _ in stream.correct(hesitant()):
            answered.set()


async def test_the_asynchronous_face_takes_over_and_is_taken_over(server: Server) -> None:
    async def endless() -> AsyncIterator[np.ndarray]:
        index = 0
        while True:
            yield gray(index)
            index += 1
            await asyncio.sleep(0.01)

    async def run(stream: unbend.AsyncStream) -> None:
        async for _ in stream.correct(endless()):
            started.set()

    started = asyncio.Event()
    async with (
        unbend.AsyncClient(server.target) as client,
        client.stream(WIDTH, HEIGHT, "gray8", stream_id="camera-9", frames=1) as older,
    ):
        running = asyncio.create_task(run(older))
        await started.wait()
        async with client.stream(WIDTH, HEIGHT, "gray8", stream_id="camera-9") as newer:
            assert newer.resumed
            with pytest.raises(unbend.StreamTakenOver):
                await running


async def test_the_asynchronous_face_can_be_cancelled(server: Server) -> None:
    async def run() -> None:
        async with (
            unbend.AsyncClient(server.target) as client,
            client.stream(WIDTH, HEIGHT, "gray8", frames=1) as stream,
        ):
            async for _ in stream.correct(grays(10_000)):
                started.set()

    started = asyncio.Event()
    running = asyncio.create_task(run())
    await started.wait()
    running.cancel()
    with pytest.raises(asyncio.CancelledError):
        await running

    for _ in range(100):
        if server.service.streams.active == 0 and not threads():
            break
        await asyncio.sleep(0.05)
    assert server.service.streams.active == 0
    assert threads() == []
