"""Runs in the container beside a service that has just started: a photograph, an estimate and a stream go through it.

Prints how long the first answer took, and what was found; anything wrong ends it with a traceback.
"""

from __future__ import annotations

import http.client
import json
import os
import sys
import time
from pathlib import Path

import numpy as np

import unbend
import unbend_service

HTTP = f"127.0.0.1:{os.environ.get('UNBEND_HTTP_PORT', '8080')}"
GRPC = f"127.0.0.1:{os.environ.get('UNBEND_GRPC_PORT', '50051')}"
OPS = f"127.0.0.1:{os.environ.get('UNBEND_OPS_PORT') or HTTP.partition(':')[2]}"
SAMPLE = Path(unbend_service.__file__).parent / "web/samples/shopfront.jpg"


def fetch(address: str, method: str, path: str, body: bytes | None = None) -> tuple[int, dict[str, str], bytes]:
    """Status, headers in lower case, body."""
    connection = http.client.HTTPConnection(address, timeout=60)
    connection.request(method, path, body)
    answer = connection.getresponse()
    return answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()


def main(wanted: str) -> None:
    """Raises AssertionError if the service does not work, or draws with another renderer than ``wanted``."""
    status, _, body = fetch(OPS, "GET", "/readyz")
    assert status == 200, body
    readiness = json.loads(body)
    assert readiness["renderer"]["name"] == wanted, readiness

    started = time.perf_counter()
    status, headers, picture = fetch(HTTP, "POST", "/v1/correct", SAMPLE.read_bytes())
    assert status == 200, picture
    assert headers["unbend-outcome"] == "corrected", headers
    assert picture.startswith(b"\xff\xd8"), picture[:16]
    first_ms = 1000 * (time.perf_counter() - started)

    frame = np.zeros((240, 320, 3), np.uint8)
    with unbend.Client(GRPC, timeout_s=60) as client:
        client.estimate(frame)
        with client.stream(width=320, height=240, pixel_format="rgb24") as stream:
            indices = [result.index for result in stream.correct(frame for _ in range(20))]
    assert indices == list(range(20)), indices

    status, _, metrics = fetch(OPS, "GET", "/metrics")
    assert status == 200, metrics
    assert b'unbend_frames_total{result="corrected"}' in metrics, metrics
    print(f"smoke test passed: {readiness['renderer']}, first photograph {first_ms:.0f} ms, 20 frames in order")


if __name__ == "__main__":
    main(sys.argv[1])
