from __future__ import annotations

import signal
import threading
import urllib.request

import cv2
import pytest

from tests.acceptance.conftest import shared_memory_names, start_server, stop_server
from tests.acceptance.test_endings import eventually
from tests.acceptance.test_http import facade


def test_sigterm_finishes_what_was_accepted_and_leaves_nothing_in_shared_memory() -> None:
    before = shared_memory_names()
    server = start_server(workers="1")
    body = cv2.imencode(".png", facade(1920, 1080))[1].tobytes()
    statuses: list[int] = []

    def correct() -> None:
        request = urllib.request.Request(f"http://{server.http}/v1/correct", data=body, method="POST")
        with urllib.request.urlopen(request, timeout=60) as answer:
            answer.read()
            statuses.append(answer.status)

    calls = [threading.Thread(target=correct) for _ in range(3)]
    for call in calls:
        call.start()
    while server.metric("unbend_stage_duration_seconds_count", stage="decode") == 0:
        pass
    server.process.send_signal(signal.SIGTERM)
    for call in calls:
        call.join()
    assert statuses == [200, 200, 200]
    assert server.process.wait(30) == 0
    stop_server(server)
    assert eventually(lambda: shared_memory_names() <= before)


@pytest.mark.egl
def test_the_egl_renderer_serves_when_it_is_asked_for() -> None:
    server = start_server(renderer="egl", workers="1")
    try:
        assert b'"egl"' in server.get("/readyz")
        body = cv2.imencode(".jpg", facade())[1].tobytes()
        request = urllib.request.Request(f"http://{server.http}/v1/correct", data=body, method="POST")
        with urllib.request.urlopen(request, timeout=60) as answer:
            assert answer.read(2) == b"\xff\xd8"
    finally:
        assert stop_server(server) == 0


def test_a_taken_port_ends_the_command_with_a_sentence() -> None:
    server = start_server(workers="1")
    try:
        with pytest.raises(AssertionError, match="did not start") as failure:
            start_server(workers="1", http_port=server.http.rpartition(":")[2])
        assert "Traceback" not in str(failure.value)
    finally:
        stop_server(server)
