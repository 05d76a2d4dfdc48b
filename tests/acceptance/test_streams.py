"""A ten-second 1280x720 video through the real service, by the client."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

import unbend
from tests.acceptance.conftest import Server
from tests.acceptance.test_http import facade

WIDTH, HEIGHT, FRAMES, RATE = 1280, 720, 300, 30


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A camera behind a barrel lens, and something that moves before it."""
    path = tmp_path_factory.mktemp("video") / "bent.mp4"
    scene = facade(WIDTH, HEIGHT)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=RATE)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.bit_rate = 6_000_000
        for i in range(FRAMES):
            picture = scene.copy()
            cv2.circle(picture, (int(WIDTH * i / FRAMES), HEIGHT // 2), 40, (0, 0, 220), -1)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        container.mux(stream.encode())
    return path


def decoded(video: Path, pixel_format: str) -> Iterator[tuple[np.ndarray | bytes, int]]:
    """(frame, timestamp in microseconds) of each frame of the file."""
    with av.open(str(video)) as container:
        for frame in container.decode(video=0):
            timestamp_us = round(frame.time * 1_000_000)
            if pixel_format == "i420":
                yield frame.to_ndarray(format="yuv420p"), timestamp_us
            else:
                yield cv2.imencode(".jpg", frame.to_ndarray(format="bgr24"))[1].tobytes(), timestamp_us


def luma(image: np.ndarray | bytes | None) -> np.ndarray:
    assert image is not None
    if isinstance(image, bytes):
        return cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_GRAYSCALE)
    return np.asarray(image).reshape(-1, WIDTH)[:HEIGHT]


@pytest.mark.parametrize("pixel_format", ["i420", "jpeg"])
def test_a_video_keeps_count_order_and_timestamps_and_is_estimated_once(
    server: Server, video: Path, pixel_format: str
) -> None:
    estimates = server.metric("unbend_estimates_total")
    timestamps = [timestamp for _, timestamp in decoded(video, "i420")]
    with (
        unbend.Client(server.grpc) as client,
        client.stream(width=WIDTH, height=HEIGHT, pixel_format=pixel_format) as stream,
    ):
        results = list(stream.correct(decoded(video, pixel_format)))
        grid_id = stream.grid.grid_id
    assert [result.index for result in results] == list(range(FRAMES))
    assert [result.timestamp_us for result in results] == timestamps
    assert {str(result.status) for result in results} == {"corrected"}
    assert luma(results[-1].image).shape == (HEIGHT, WIDTH)
    assert server.metric("unbend_estimates_total") == estimates + 1
    with unbend.Client(server.grpc) as client:
        assert client.grids.get(grid_id).grid_id == grid_id


def test_a_stream_that_dropped_is_resumed_with_the_same_grid_and_no_second_estimate(
    server: Server, video: Path
) -> None:
    estimates = server.metric("unbend_estimates_total")
    grid_ids = []
    for _ in range(2):
        with (
            unbend.Client(server.grpc) as client,
            client.stream(width=WIDTH, height=HEIGHT, pixel_format="i420", stream_id="camera-7") as stream,
        ):
            for _ in itertools.islice(stream.correct(decoded(video, "i420")), 20):
                pass
            grid_ids.append(stream.grid.grid_id)
    assert grid_ids[0] == grid_ids[1]
    assert server.metric("unbend_estimates_total") == estimates + 1


def test_a_worker_killed_in_the_middle_costs_no_frame(server: Server, video: Path) -> None:
    restarts = server.metric("unbend_worker_restarts_total")
    indices = []
    with (
        unbend.Client(server.grpc) as client,
        client.stream(width=WIDTH, height=HEIGHT, pixel_format="i420") as stream,
    ):
        for result in stream.correct(itertools.islice(decoded(video, "i420"), 150)):
            indices.append(result.index)
            assert str(result.status) == "corrected"
            if result.index in (40, 90):
                server.workers()[0].kill()
    assert indices == list(range(150))
    deadline = time.monotonic() + 60  # so long only where other tests have the cores
    while server.metric("unbend_worker_restarts_total") < restarts + 2 and time.monotonic() < deadline:
        time.sleep(0.1)
    assert server.metric("unbend_worker_restarts_total") == restarts + 2


@pytest.mark.parametrize(
    ("name", "pixel_format", "frame", "error"),
    [
        ("size", "rgb24", np.zeros((5, 5, 3), np.uint8), unbend.UnbendError),
        ("format", "yuv999", np.zeros((48, 64, 3), np.uint8), unbend.UnbendError),
    ],
)
def test_a_wrong_frame_size_or_format_is_a_typed_error_and_the_service_still_serves(
    server: Server, name: str, pixel_format: str, frame: np.ndarray, error: type[Exception]
) -> None:
    with unbend.Client(server.grpc) as client:
        with (
            pytest.raises(error),
            client.stream(width=64, height=48, pixel_format=pixel_format) as stream,
        ):
            list(stream.correct([frame]))
        assert client.correct(np.zeros((48, 64, 3), np.uint8)).image.shape == (48, 64, 3)
