from __future__ import annotations

import httpx
import pytest
import structlog

from .conftest import Bench


async def test_a_request_id_is_taken_over(client: httpx.AsyncClient) -> None:
    """A caller's own id comes back, so that logs of both sides can be joined."""
    response = await client.get("/livez", headers={"X-Request-Id": "trace-42"})
    assert response.headers["x-request-id"] == "trace-42"


@pytest.mark.parametrize("offered", ["", "a b", "x" * 129, "né", '"; drop'])
async def test_a_request_id_is_made_otherwise(client: httpx.AsyncClient, offered: str) -> None:
    """An id that could spoil a log line is replaced; each request gets its own."""
    headers = {"X-Request-Id": offered.encode("latin-1")}
    first = (await client.get("/livez", headers=headers)).headers["x-request-id"]
    second = (await client.get("/livez", headers=headers)).headers["x-request-id"]
    assert first not in (offered, second)
    assert len(first) == 32


async def test_each_request_is_logged_once(client: httpx.AsyncClient, jpeg: bytes) -> None:
    """One line a request, with method, path, status and seconds; probes stay below info."""
    with structlog.testing.capture_logs() as logs:
        await client.post("/v1/estimate?strength=0.5", content=jpeg)
        await client.get("/livez")
    lines = [entry for entry in logs if entry["event"] == "request" and entry["log_level"] == "info"]
    assert [(line["method"], line["path"], line["status"]) for line in lines] == [("POST", "/v1/estimate", 200)]
    assert lines[0]["seconds"] > 0


async def test_failures_are_counted(bench: Bench, jpeg: bytes) -> None:
    """A 500 shows in the metrics like any other code."""
    bench.estimator.failure = RuntimeError("broken")
    with structlog.testing.capture_logs():
        await bench.client.post("/v1/estimate", content=jpeg)
    text = (await bench.client.get("/metrics")).text
    assert 'unbend_requests_total{code="500",method="POST /v1/estimate",transport="http"} 1.0' in text
