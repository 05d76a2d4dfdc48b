"""Hostile input against a real service: it is refused by name, and the service goes on."""

from __future__ import annotations

import io
import json
import urllib.error
import urllib.request
from collections.abc import Iterator

import psutil
import pytest
from PIL import Image

from .conftest import Server, start_server, stop_server


def png(width: int, height: int) -> bytes:
    out = io.BytesIO()
    Image.new("RGB", (width, height), (90, 120, 30)).save(out, "png", compress_level=1)
    return out.getvalue()


@pytest.fixture(scope="module")
def guarded() -> Iterator[Server]:
    running = start_server(decode_memory_bytes=str(64 << 20), decoders="1")
    yield running
    assert stop_server(running) == 0


def post(server: Server, body: bytes) -> tuple[int, bytes]:
    request = urllib.request.Request(f"http://{server.http}/v1/estimate", data=body)
    try:
        with urllib.request.urlopen(request, timeout=60) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read()


def decoders(server: Server) -> list[psutil.Process]:
    children = psutil.Process(server.process.pid).children()
    return [child for child in children if "unbend_service.adapters.decoding.decoder" in child.cmdline()]


def test_a_picture_that_exhausts_its_decoder_is_refused_and_the_next_is_served(guarded: Server) -> None:
    """The front does not notice."""
    status, body = post(guarded, png(8000, 5000))
    assert (status, json.loads(body)["code"]) == (422, "image_too_costly")
    assert post(guarded, png(64, 48))[0] == 200
    assert guarded.metric("unbend_worker_restarts_total", reason="decoder_exhausted") >= 1


def test_decoders_that_are_killed_are_replaced(guarded: Server) -> None:
    """Nobody is answered with an error."""
    assert post(guarded, png(64, 50))[0] == 200
    for process in decoders(guarded):
        process.kill()
    assert post(guarded, png(64, 49))[0] == 200
    assert guarded.process.poll() is None


def test_no_decoder_outlives_the_service() -> None:
    """Not even when the service is killed."""
    running = start_server(decoders="2")
    assert post(running, png(64, 51))[0] == 200
    found = decoders(running)
    assert found
    running.process.kill()
    _, alive = psutil.wait_procs(found, timeout=10)
    stop_server(running)
    assert not alive
