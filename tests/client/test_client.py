"""Unary calls of both faces, against a real server over fakes."""

from __future__ import annotations

import asyncio
import inspect
import socket
import threading
import time

import cv2
import numpy as np
import pytest

import unbend
from tests.client.conftest import Server
from unbend._options import CorrectOptions, EstimateOptions, StreamKeywords
from unbend_service.domain import errors as service_errors


@pytest.mark.parametrize(
    ("pixel_format", "shape"),
    [
        (None, (48, 64)),
        (None, (48, 64, 3)),
        (None, (48, 64, 4)),
        ("gray8", (48, 64)),
        ("bgr24", (48, 64, 3)),
        ("bgra", (48, 64, 4)),
        ("i420", (72, 64)),
        ("nv12", (72, 64)),
        (None, (1, 1)),
    ],
)
def test_an_array_comes_back_as_a_writable_array_of_its_shape(
    client: unbend.Client, pixel_format: str | None, shape: tuple[int, ...]
) -> None:
    image = np.random.default_rng(1).integers(0, 255, shape, dtype=np.uint8)

    correction = client.correct(image, pixel_format=pixel_format)

    assert correction.image.shape == shape
    assert correction.image.dtype == np.uint8
    assert correction.image.flags.writeable
    assert correction.outcome is unbend.Outcome.CORRECTED
    assert correction.confidence == pytest.approx(0.9)


def test_an_array_that_is_not_contiguous_is_sent_as_it_looks(client: unbend.Client, picture: np.ndarray) -> None:
    mirrored = picture[:, ::-1]

    one, other = client.correct(mirrored), client.correct(mirrored.copy())

    assert np.array_equal(one.image, other.image)


@pytest.mark.parametrize("extension", [".jpg", ".png", ".webp"])
def test_a_file_comes_back_as_a_file_of_its_kind(client: unbend.Client, picture: np.ndarray, extension: str) -> None:
    body = cv2.imencode(extension, picture)[1].tobytes()

    image = client.correct(body).image

    assert isinstance(image, bytes)
    assert image[:3] == body[:3]
    assert cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR).shape == picture.shape


def test_a_file_of_another_kind_may_be_asked_for(client: unbend.Client, picture: np.ndarray) -> None:
    body = cv2.imencode(".jpg", picture)[1].tobytes()

    assert client.correct(body, answer_format="png").image.startswith(b"\x89PNG")


def test_an_estimate_gives_the_lattice_and_the_guides(client: unbend.Client, picture: np.ndarray) -> None:
    estimate = client.estimate(picture)

    assert estimate.grid.source.shape == (17, 17, 2)
    assert estimate.guides is not None
    assert [guide.anchor for guide in estimate.guides.rows] == [-0.9, -0.3, 0.3, 0.9]
    assert estimate.record.model == "fake"


def test_whatever_stands_for_a_grid_can_correct(client: unbend.Client, picture: np.ndarray) -> None:
    estimate = client.estimate(picture, correct="all")
    assert estimate.guides is not None

    pictures = [
        client.correct(picture, grid=grid).image
        for grid in (estimate, estimate.grid_id, estimate.record, estimate.grid, estimate.guides)
    ]

    assert all(np.array_equal(pictures[0], other) for other in pictures[1:])


def test_options_reach_the_server(client: unbend.Client, picture: np.ndarray) -> None:
    assert np.array_equal(client.correct(picture, strength=0.0, fit="keep").image, picture)
    assert client.correct(picture, min_confidence=0.95).reason == "low_confidence"
    full = client.correct(picture, fit="full", border=unbend.Border(255, 0, 0)).image
    assert (full == (255, 0, 0)).all(axis=-1).any()
    assert not np.array_equal(client.correct(picture, fit=0.5).image, client.correct(picture, fit="crop").image)


def test_grids_are_kept_and_forgotten(client: unbend.Client, picture: np.ndarray) -> None:
    lattice = client.estimate(picture).grid

    record = client.grids.put(lattice)
    stored = client.grids.get(record.grid_id)
    client.grids.delete(record.grid_id)

    assert stored.grid is not None
    assert np.array_equal(stored.grid.source, lattice.source)
    with pytest.raises(unbend.GridNotFound) as missing:
        client.grids.get(record.grid_id)
    assert isinstance(missing.value, LookupError)


BAD_GRIDS = {
    "nan": np.full((3, 3, 2), np.nan, np.float32),
    "folded": np.stack(np.meshgrid([0.9, 0.0, -0.9], [-0.9, 0.9, -0.5]), axis=-1).astype(np.float32),
    "far": np.full((3, 3, 2), 99, np.float32),
}


@pytest.mark.parametrize(
    ("name", "error"), [("nan", unbend.InvalidGrid), ("folded", unbend.FoldedGrid), ("far", unbend.InvalidGrid)]
)
def test_a_grid_that_cannot_be_is_refused_with_its_error(
    client: unbend.Client, name: str, error: type[Exception]
) -> None:
    with pytest.raises(error):
        client.grids.put(unbend.Grid(BAD_GRIDS[name]))


@pytest.mark.parametrize(
    ("image", "options", "error"),
    [
        (b"", {}, unbend.EmptyBody),
        (b"text, not an image", {}, unbend.UnsupportedMediaType),
        (b"\xff\xd8\xff\xe0 and no more", {}, unbend.InvalidImage),
        (bytes(2 << 20), {}, unbend.BodyTooLarge),
        (b"raw", {"pixel_format": "rgb24"}, unbend.InvalidFrame),
        (np.zeros((4, 4)), {}, unbend.InvalidFrame),
        (np.zeros((4, 4, 2), np.uint8), {}, unbend.InvalidFrame),
        (np.zeros((0, 4, 3), np.uint8), {}, unbend.InvalidFrame),
        (np.zeros((4, 4, 3), np.uint8), {"pixel_format": "rgba"}, unbend.InvalidFrame),
        (np.zeros((5, 4), np.uint8), {"pixel_format": "i420"}, unbend.InvalidFrame),
        (np.zeros((4, 4, 3), np.uint8), {"pixel_format": "yuv999"}, unbend.UnsupportedPixelFormat),
        (np.zeros((4, 4, 3), np.uint8), {"pixel_format": "jpeg"}, unbend.InvalidFrame),
        (np.zeros((4, 4, 3), np.uint8), {"grid": "gnone"}, unbend.GridNotFound),
        (np.zeros((4, 4, 3), np.uint8), {"fit": "sideways"}, unbend.InvalidOption),
        (np.zeros((4, 4, 3), np.uint8), {"correct": "everything"}, unbend.InvalidOption),
        (np.zeros((4, 4, 3), np.uint8), {"strength": 2.0}, unbend.InvalidOption),
        (np.zeros((4, 4, 3), np.uint8), {"quality": 0}, unbend.InvalidOption),
        (np.zeros((4, 4, 3), np.uint8), {"border": unbend.Border(300, 0, 0)}, unbend.InvalidOption),
        (np.zeros((4, 4, 3), np.uint8), {"answer_format": "gif"}, unbend.InvalidOption),
    ],
)
def test_bad_input_is_a_typed_error_and_the_next_call_works(
    client: unbend.Client, picture: np.ndarray, image: object, options: dict[str, object], error: type[Exception]
) -> None:
    with pytest.raises(error) as refused:
        client.correct(image, **options)

    assert isinstance(refused.value, (ValueError, LookupError))
    assert client.correct(picture).image.shape == picture.shape


def test_an_error_says_what_is_allowed_and_which_setting_governs_it(client: unbend.Client) -> None:
    with pytest.raises(unbend.BodyTooLarge) as refused:
        client.correct(bytes(2 << 20))

    assert refused.value.allowed == "1048576 bytes"
    assert refused.value.setting == "body_bytes"
    assert "Setting: body_bytes" in str(refused.value)


def test_an_unreachable_server_is_a_connection_error_soon() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        target = f"127.0.0.1:{taken.getsockname()[1]}"
        start = time.monotonic()
        with unbend.Client(target) as client, pytest.raises(unbend.Unreachable) as error:
            client.estimate(np.zeros((4, 4), np.uint8))

    assert isinstance(error.value, ConnectionError)
    assert time.monotonic() - start < 5


def test_a_server_that_comes_back_is_found_again(server: Server, picture: np.ndarray) -> None:
    client = unbend.Client(server.target, retries=8)
    client.correct(picture)
    server.stop()
    replica: list[Server] = []
    later = threading.Timer(0.1, lambda: replica.append(Server(port=server.port)))
    later.start()

    correction = client.correct(picture)

    assert correction.image.shape == picture.shape
    client.close()
    later.join()
    replica[0].stop()


def test_a_full_queue_is_tried_again_after_the_pause_that_the_server_asks_for(
    server: Server, picture: np.ndarray
) -> None:
    server.pool.failure = service_errors.QueueFull("Full.", retry_after_s=0.3)
    start = time.monotonic()

    with unbend.Client(server.target, retries=2) as client, pytest.raises(unbend.QueueFull):
        client.correct(picture)

    assert [code for _, _, code in server.meter.requests] == ["RESOURCE_EXHAUSTED"] * 3
    assert time.monotonic() - start >= 0.6


def test_a_frame_that_kills_workers_is_not_sent_again(
    server: Server, client: unbend.Client, picture: np.ndarray
) -> None:
    server.pool.failure = service_errors.PoisonFrame("Two workers died.")

    with pytest.raises(unbend.PoisonFrame):
        client.correct(picture)

    assert [code for _, _, code in server.meter.requests] == ["INTERNAL"]


def test_a_call_that_takes_too_long_is_a_timeout_error(server: Server, picture: np.ndarray) -> None:
    server.pool.failure = service_errors.QueueFull("Full.", retry_after_s=60)
    with unbend.Client(server.target, timeout_s=0.5, retries=5) as client:
        start = time.monotonic()
        with pytest.raises(TimeoutError):
            client.correct(picture)
    assert time.monotonic() - start < 2


def test_a_closed_client_says_so(server: Server, picture: np.ndarray) -> None:
    client = unbend.Client(server.target)
    client.close()

    with pytest.raises(unbend.Closed):
        client.correct(picture)


async def test_the_asynchronous_face_answers_the_same(
    server: Server, client: unbend.Client, picture: np.ndarray
) -> None:
    async with unbend.AsyncClient(server.target) as other:
        corrections = await asyncio.gather(*[other.correct(picture, fit="full") for _ in range(8)])
        estimate = await other.estimate(picture)
        record = await other.grids.put(estimate.grid)
        with_lattice = await other.correct(picture, grid=estimate.grid, fit="full")
        stored = await other.grids.get(record.grid_id)
        await other.grids.delete(record.grid_id)
        with pytest.raises(unbend.GridNotFound):
            await other.grids.delete(record.grid_id)
        with pytest.raises(unbend.InvalidOption):
            await other.correct(picture, fit="sideways")
    expected = client.correct(picture, fit="full").image

    assert all(np.array_equal(correction.image, expected) for correction in corrections)
    assert np.array_equal(with_lattice.image, expected)
    assert stored.grid_id == estimate.grid_id
    with pytest.raises(unbend.Closed):
        await other.estimate(picture)


async def test_a_cancelled_call_is_cancelled_on_the_server_too(server: Server, picture: np.ndarray) -> None:
    server.pool.failure = service_errors.QueueFull("Full.", retry_after_s=5)
    async with unbend.AsyncClient(server.target) as client:
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(client.correct(picture), 0.3)


def test_the_asynchronous_face_takes_the_options_of_the_other() -> None:
    def keywords(method: object) -> set[str]:
        parameters = inspect.signature(method).parameters.values()
        return {p.name for p in parameters if p.kind is inspect.Parameter.KEYWORD_ONLY}

    assert set(CorrectOptions.__annotations__) | set(EstimateOptions.__annotations__) | {"grid"} == keywords(
        unbend.Client.correct
    )
    assert set(EstimateOptions.__annotations__) == keywords(unbend.Client.estimate)
    assert set(StreamKeywords.__annotations__) == keywords(unbend.Client.stream)
