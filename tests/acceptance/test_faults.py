"""Callers that go away, and a machine that is not as it should be."""

from __future__ import annotations

import ast
import http.client
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import grpc
import pytest

import unbend_service
from tests.acceptance.conftest import Server, start_server, stop_server
from tests.acceptance.test_endings import eventually
from tests.acceptance.test_http import facade
from unbend.v1 import correction_pb2, correction_pb2_grpc, frame_pb2

BODY = cv2.imencode(".jpg", facade(640, 480))[1].tobytes()
STREAM = """
import sys, time
import numpy as np
import unbend

with unbend.Client(sys.argv[1]) as client, client.stream(64, 48, "gray8") as stream:
    for result in stream.correct(np.zeros((48, 64), np.uint8) for _ in range(1_000_000)):
        print(result.index, flush=True)
"""


@pytest.fixture
def stuck() -> Iterator[Server]:
    """A service whose only render worker is stopped: whatever has to be drawn waits."""
    server = start_server(workers="1", hang_s="30")
    try:
        worker = server.workers()[0]
        worker.suspend()
        yield server
        worker.resume()
        assert stop_server(server) == 0
    finally:
        server.process.kill()
        server.process.wait(10)


def active(server: Server) -> int:
    return int(json.loads(server.get("/readyz"))["active"])


def test_work_ends_when_its_caller_closes_the_connection(stuck: Server) -> None:
    """Nothing is left under way for a caller of HTTP who is gone, long before any deadline; he is counted as 499."""
    connection = http.client.HTTPConnection(stuck.http)
    connection.request("POST", "/v1/correct?min_confidence=0", BODY)
    assert eventually(lambda: active(stuck) == 1)
    connection.close()
    assert eventually(lambda: active(stuck) == 0, 10)
    assert stuck.metric("unbend_requests_total", code="499") == 1


def test_the_deadline_of_the_caller_ends_the_work(stuck: Server) -> None:
    """Over HTTP by its header and over gRPC by the call's own; nothing is left under way."""
    connection = http.client.HTTPConnection(stuck.http)
    connection.request("POST", "/v1/correct?min_confidence=0", BODY, {"Unbend-Timeout-S": "1.5"})
    answer = connection.getresponse()
    assert (answer.status, json.load(answer)["code"]) == (504, "deadline_exceeded")
    connection.close()
    with grpc.insecure_channel(stuck.grpc) as channel:
        request = correction_pb2.CorrectRequest(
            format=frame_pb2.FrameFormat(pixel_format=frame_pb2.PIXEL_FORMAT_JPEG), data=BODY, min_confidence=0
        )
        with pytest.raises(grpc.RpcError) as refusal:
            correction_pb2_grpc.CorrectionServiceStub(channel).Correct(request, timeout=1.5)
    assert refusal.value.code() is grpc.StatusCode.DEADLINE_EXCEEDED
    assert eventually(lambda: active(stuck) == 0, 10)


def test_a_client_killed_in_the_middle_of_a_stream_leaves_nothing_open(server: Server) -> None:
    """kill -9 of a client: the service forgets the session, and goes on."""
    with subprocess.Popen(
        [sys.executable, "-c", STREAM, server.grpc], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as client:
        assert client.stdout is not None
        for line in client.stdout:
            if int(line) >= 20:
                client.kill()
    assert eventually(lambda: server.metric("unbend_streams_active") == 0)
    assert eventually(lambda: active(server) == 0)


def test_a_full_dev_shm_costs_nothing() -> None:
    """Frames under way do not lie there."""
    fill = 'mount -t tmpfs -o size=16k tmpfs /dev/shm && { cat /dev/zero > /dev/shm/full 2>/dev/null; exec "$@"; }'
    isolated = ("unshare", "--mount", "sh", "-c", fill, "sh")
    if os.geteuid() != 0 or subprocess.run([*isolated, "true"], capture_output=True, check=False).returncode != 0:
        pytest.skip("a /dev/shm of its own can be mounted by root only")
    server = start_server(before=isolated, workers="1")
    try:
        connection = http.client.HTTPConnection(server.http)
        connection.request("POST", "/v1/correct?min_confidence=0", BODY)
        answer = connection.getresponse()
        assert answer.read(2) == b"\xff\xd8"
        connection.close()
    finally:
        assert stop_server(server) == 0


def test_no_duration_is_measured_by_a_clock_that_may_be_set() -> None:
    """Deadlines and time-outs are told by monotonic clocks; the grid store alone asks the wall clock, once."""
    asked = set()
    root = Path(unbend_service.__file__).parent
    for source in root.rglob("*.py"):
        for node in ast.walk(ast.parse(source.read_text())):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                name = f"{node.value.id}.{node.attr}"
                if name in {"time.time", "datetime.now", "datetime.utcnow", "datetime.today"}:
                    asked.add(str(source.relative_to(root)))
    assert asked <= {"adapters/grid_stores/sqlite.py"}
