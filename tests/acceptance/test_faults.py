"""Callers that go away, and a machine that is not as it should be."""

from __future__ import annotations

import ast
import http.client
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import grpc
import numpy as np
import psutil
import pytest

import unbend
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


@pytest.fixture(scope="module")
def impatient() -> Iterator[Server]:
    """A service that gives a stream up in which nothing moves for three seconds."""
    server = start_server(workers="1", stream_idle_s="3")
    yield server
    assert stop_server(server) == 0


def held_bytes(server: Server) -> int:
    """Memory of the parent, frames in shared memory included."""
    return int(psutil.Process(server.process.pid).memory_info().rss)


def answered(server: Server, frames: int) -> list[int]:
    """The indices that a stream of small frames is answered with."""
    with unbend.Client(server.grpc) as client, client.stream(64, 48, "gray8") as stream:
        return [result.index for result in stream.correct(np.zeros((48, 64), np.uint8) for _ in range(frames))]


def test_who_does_not_read_bounds_his_own_memory_only(impatient: Server) -> None:
    """His frames are read no further, other streams are answered meanwhile, and in the end he is given up."""
    answered(impatient, 30)
    before_bytes = held_bytes(impatient)
    sent = 0

    def requests() -> Iterator[correction_pb2.CorrectStreamRequest]:
        nonlocal sent
        layout = frame_pb2.FrameFormat(pixel_format=frame_pb2.PIXEL_FORMAT_RGB24, width=1280, height=720)
        yield correction_pb2.CorrectStreamRequest(open=correction_pb2.StreamOpen(format=layout))
        for index in range(1000):
            sent += 1
            frame = correction_pb2.StreamFrame(index=index, data=bytes(1280 * 720 * 3))
            yield correction_pb2.CorrectStreamRequest(frame=frame)

    options = [("grpc.max_send_message_length", -1), ("grpc.http2.bdp_probe", 0)]
    with grpc.insecure_channel(impatient.grpc, options) as channel:
        call = correction_pb2_grpc.CorrectionServiceStub(channel).CorrectStream(requests())
        assert eventually(lambda: sent >= 8)
        assert answered(impatient, 60) == list(range(60))
        assert impatient.metric("unbend_streams_active") == 1
        assert sent < 40
        assert held_bytes(impatient) - before_bytes < 128 << 20  # 1000 frames of his take twenty times as much
        assert eventually(lambda: impatient.metric("unbend_streams_active") == 0)
        call.cancel()
    assert eventually(lambda: active(impatient) == 0)


def test_a_client_who_falls_silent_without_a_word_is_given_up(impatient: Server) -> None:
    """Its connection stands, as that of a machine that lost its network does: the stream ends, others go on."""
    with subprocess.Popen(
        [sys.executable, "-c", STREAM, impatient.grpc], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as client:
        assert client.stdout is not None
        for line in client.stdout:
            if int(line) >= 20:
                break
        client.send_signal(signal.SIGSTOP)
        try:
            assert answered(impatient, 30) == list(range(30))
            assert eventually(lambda: impatient.metric("unbend_streams_active") == 0)
            assert eventually(lambda: active(impatient) == 0)
        finally:
            client.kill()


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
