"""Estimation and rendering in processes of their own."""

from __future__ import annotations

import json
from collections.abc import Iterator

import cv2
import numpy as np
import pytest

import unbend
from benchmarks.companions import free_port
from tests.acceptance.conftest import Server, start_server, stop_server
from tests.acceptance.test_http import facade, post

WIDTH, HEIGHT = 640, 480


@pytest.fixture(scope="module")
def estimating() -> Iterator[Server]:
    running = start_server(role="estimate", grpc_port=str(free_port()))
    yield running
    assert stop_server(running) == 0


@pytest.fixture(scope="module")
def rendering(estimating: Server) -> Iterator[Server]:
    running = start_server(role="render", estimator_address=estimating.grpc, renderer="cpu", workers="1")
    yield running
    assert stop_server(running) == 0


def frames(count: int) -> Iterator[np.ndarray]:
    scene = facade(WIDTH, HEIGHT)
    for i in range(count):
        picture = scene.copy()
        cv2.circle(picture, (40 + 5 * i, HEIGHT // 2), 20, (0, 0, 220), -1)
        yield picture


def test_a_node_that_renders_has_its_estimates_made_elsewhere(estimating: Server, rendering: Server) -> None:
    """A stream is straightened as ever; what was estimated is what one node with both roles would have estimated."""
    with (
        unbend.Client(rendering.grpc) as client,
        client.stream(width=WIDTH, height=HEIGHT, pixel_format="bgr24", min_confidence=0.0) as stream,
    ):
        results = list(stream.correct(frames(20)))
    assert [result.index for result in results] == list(range(20))
    assert {str(result.status) for result in results} == {"corrected"}
    assert rendering.metric("unbend_estimates_total") == 1
    assert estimating.metric("unbend_stage_duration_seconds_count", stage="estimate") == 5
    picture = next(frames(1))
    with unbend.Client(rendering.grpc) as asked, unbend.Client(estimating.grpc) as itself:
        assert asked.estimate(picture).grid_id == itself.estimate(picture).grid_id


def test_both_nodes_say_what_they_do(estimating: Server, rendering: Server) -> None:
    """Readiness names the role, and the network that estimates, wherever that is."""
    there, here = (json.loads(server.get("/readyz")) for server in (estimating, rendering))
    assert (there["role"], here["role"]) == ("estimate", "render")
    assert there["workers"] == []
    assert there["renderer"] is None
    assert len(here["workers"]) == 1
    assert here["model"] == there["model"]
    assert estimating.workers() == []


def test_a_node_that_estimates_refuses_to_render(estimating: Server) -> None:
    """It says so with a typed error, over gRPC and HTTP, for single pictures and for streams, and keeps estimating."""
    picture = next(frames(1))
    with unbend.Client(estimating.grpc) as client:
        with pytest.raises(unbend.NotServedHere, match="role"):
            client.correct(picture)
        with (
            pytest.raises(unbend.NotServedHere),
            client.stream(width=WIDTH, height=HEIGHT, pixel_format="bgr24") as stream,
        ):
            list(stream.correct([picture]))
        assert client.estimate(picture).grid_id
    body = cv2.imencode(".jpg", picture)[1].tobytes()
    status, _, answer = post(estimating, "/v1/correct", body)
    assert status == 501
    assert json.loads(answer)["code"] == "not_served_here"


def test_without_its_estimator_a_node_still_renders_known_grids() -> None:
    """Estimates fail with a typed error that says which setting; pictures with a stored grid are rendered."""
    away = f"127.0.0.1:{free_port()}"
    alone = start_server(role="render", estimator_address=away, estimator_timeout_s="2", renderer="cpu", workers="1")
    try:
        picture = next(frames(1))
        with unbend.Client(alone.grpc, retries=0) as client:
            with pytest.raises(unbend.EstimatorUnavailable, match="estimator_address"):
                client.correct(picture)
            rows = np.linspace(-1, 1, 9, dtype=np.float32)
            lattice = np.stack(np.meshgrid(0.9 * rows, 0.9 * rows), axis=-1)
            grid = client.grids.put(unbend.Grid(lattice))
            assert client.correct(picture, grid=grid.grid_id).image.shape == picture.shape
    finally:
        assert stop_server(alone) == 0


def test_a_node_that_renders_has_to_know_who_estimates() -> None:
    """It does not start without, and says which setting is missing."""
    with pytest.raises(AssertionError, match="estimator_address"):
        start_server(role="render")
