"""How the service ends, and what is left of it."""

from __future__ import annotations

import http.client
import os
import signal
import threading
import time
from collections import Counter
from pathlib import Path

import cv2
import grpc
import numpy as np
import psutil
import pytest

import unbend
from tests.acceptance.conftest import Server, shared_memory_names, start_server, stop_server
from tests.acceptance.test_http import facade
from unbend.v1 import correction_pb2, correction_pb2_grpc, frame_pb2

WIDTH, HEIGHT = 320, 240


def eventually(condition: object, patience_s: float = 20.0) -> bool:
    end = time.monotonic() + patience_s
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.02)
    return True


class Load:
    """Calls over both transports until they are refused; counts how each ended."""

    def __init__(self, server: Server) -> None:
        self.server = server
        self.ends: Counter[str] = Counter()
        self.lost: list[str] = []
        self.body = cv2.imencode(".jpg", facade(640, 480))[1].tobytes()
        self.threads = [threading.Thread(target=work) for work in (self.http, self.http, self.unary, self.stream)]

    def http(self) -> None:
        connection = http.client.HTTPConnection(self.server.http, timeout=60)
        while True:
            fresh = connection.sock is None
            if fresh:
                try:
                    connection.connect()
                except OSError:
                    return  # no longer listening: nothing was accepted
            try:
                connection.request("POST", "/v1/correct?min_confidence=0", self.body)
                answer = connection.getresponse()
                answer.read()
            except OSError as error:
                if not fresh:  # a new connection may have waited in the kernel, and never have been accepted
                    self.lost.append(f"http: {error!r}")
                return
            self.ends[f"http {answer.status}"] += 1
            if answer.status == 503:
                return

    def unary(self) -> None:
        with unbend.Client(self.server.grpc, retries=0) as client:
            while True:
                try:
                    client.correct(np.zeros((HEIGHT, WIDTH), np.uint8), min_confidence=0.0)
                except unbend.Draining:
                    self.ends["grpc draining"] += 1
                    return
                except unbend.Unreachable as error:
                    if "refused" not in str(error):
                        self.lost.append(f"grpc: {error!r}")
                    return
                self.ends["grpc ok"] += 1

    def stream(self) -> None:
        """Frames one by one, as fast as they are answered, with the raw stub: its status is seen as it comes."""
        with grpc.insecure_channel(self.server.grpc) as channel:
            opening = correction_pb2.StreamOpen(
                stream_id="camera",
                format=frame_pb2.FrameFormat(pixel_format=frame_pb2.PIXEL_FORMAT_GRAY8, width=WIDTH, height=HEIGHT),
            )
            sent = 0

            def requests() -> object:
                nonlocal sent
                yield correction_pb2.CorrectStreamRequest(open=opening)
                while True:
                    frame = correction_pb2.StreamFrame(index=sent, data=bytes(WIDTH * HEIGHT))
                    sent += 1
                    yield correction_pb2.CorrectStreamRequest(frame=frame)
                    time.sleep(0.01)

            answered: list[int] = []
            try:
                responses = correction_pb2_grpc.CorrectionServiceStub(channel).CorrectStream(requests())
                answered.extend(r.result.index for r in responses if r.WhichOneof("message") == "result")
            except grpc.RpcError as error:
                trailing = dict(error.trailing_metadata())
                if error.code() is not grpc.StatusCode.UNAVAILABLE or trailing["unbend-error-code"] != "draining":
                    self.lost.append(f"stream: {error!r}")
                if trailing["unbend-error-stream-id"] != "camera" or answered != list(range(len(answered))):
                    self.lost.append(f"stream: {trailing} after {answered}")
                if int(trailing["unbend-error-last-index"]) != answered[-1]:
                    self.lost.append(f"stream: told {trailing} after {answered[-1]}")
                self.ends["stream draining"] += 1


def test_sigterm_under_load_loses_nothing_that_was_accepted() -> None:
    """Every call is answered or refused by name, streams hear where to go on, and the exit status is 0."""
    server = start_server(workers="2", drain_notice_s="3.0")
    try:
        load = Load(server)
        for thread in load.threads:
            thread.start()
        assert eventually(lambda: min(load.ends["http 200"], load.ends["grpc ok"]) >= 5)
        server.process.send_signal(signal.SIGTERM)
        assert eventually(lambda: b'"ready":false' in unready(server), 2.9), "readiness flips before calls are refused"
        for thread in load.threads:
            thread.join(30)
        assert server.process.wait(30) == 0
        assert load.lost == []
        calls = [entry for entry in server.lines if entry["event"] == "request" and "status" in entry]
        logged = Counter(f"http {entry['status']}" for entry in calls)  # calls of gRPC have a code instead
        assert logged == {end: count for end, count in load.ends.items() if end.startswith("http")}
        assert load.ends["stream draining"] == 1
        assert set(load.ends) <= {"http 200", "http 503", "grpc ok", "grpc draining", "stream draining"}
    finally:
        server.process.kill()
        stop_server(server)


def unready(server: Server) -> bytes:
    connection = http.client.HTTPConnection(server.http, timeout=5)
    try:
        connection.request("GET", "/readyz")
        return connection.getresponse().read()
    except OSError:
        return b""
    finally:
        connection.close()


@pytest.mark.parametrize("first", [signal.SIGTERM, signal.SIGINT])
def test_a_second_signal_ends_the_service_at_once(first: signal.Signals) -> None:
    """Whoever does not want to wait for work under way says so again; no worker outlives that."""
    server = start_server(workers="1", drain_s="25")
    children = psutil.Process(server.process.pid).children()
    waiting = http.client.HTTPConnection(server.http)
    waiting.putrequest("POST", "/v1/correct")
    waiting.putheader("Content-Length", "1000")
    waiting.endheaders(b"not all of it")  # accepted, and under way for as long as it likes
    assert eventually(lambda: b'"active":1' in server.get("/readyz"))
    server.process.send_signal(first)
    assert eventually(lambda: any(entry["event"] == "draining" for entry in server.lines))
    assert server.process.poll() is None
    server.process.send_signal(signal.SIGTERM)
    assert server.process.wait(10) == 1
    waiting.close()
    stop_server(server)
    assert not psutil.wait_procs(children, 10)[1]


def test_kill_9_of_the_service_leaves_nothing_behind(tmp_path: Path) -> None:
    """No worker, nothing in /dev/shm, nothing in the folder for temporary files; not even of a stopped worker."""
    before = shared_memory_names()
    os.environ["TMPDIR"], old = str(tmp_path), os.environ.get("TMPDIR")
    try:
        server = start_server(workers="2")
    finally:
        os.environ.pop("TMPDIR") if old is None else os.environ.update(TMPDIR=old)
    load = Load(server)
    workers = server.workers()
    threads = [threading.Thread(target=load.http, daemon=True) for _ in range(2)]
    for thread in threads:
        thread.start()
    assert eventually(lambda: load.ends["http 200"] >= 2)
    workers[0].suspend()
    server.process.kill()
    assert server.process.wait(10) == -signal.SIGKILL
    assert not psutil.wait_procs(workers, 10)[1]
    for thread in threads:
        thread.join(30)
    stop_server(server)
    assert eventually(lambda: shared_memory_names() <= before)
    assert list(tmp_path.iterdir()) == []
