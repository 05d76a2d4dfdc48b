from __future__ import annotations

from collections.abc import AsyncIterator

import httpx
import pytest

from .conftest import Bench

LIMIT = 300_000


async def chunks(count: int, size: int, sent: list[int]) -> AsyncIterator[bytes]:
    for _ in range(count):
        sent.append(size)
        yield bytes(size)


async def test_an_announced_length_is_refused_before_it_is_read(bench: Bench) -> None:
    """Content-Length over the limit is enough; not a byte of the body is waited for."""
    received = 0

    async def receive() -> dict[str, object]:
        nonlocal received
        received += 1
        return {"type": "http.request", "body": bytes(1000), "more_body": True}

    messages: list[dict[str, object]] = []

    async def send(message: dict[str, object]) -> None:
        messages.append(message)

    scope = {
        "type": "http",
        "http_version": "1.1",
        "method": "POST",
        "path": "/v1/correct",
        "raw_path": b"/v1/correct",
        "query_string": b"",
        "headers": [(b"content-length", str(LIMIT + 1).encode())],
    }
    await bench.app(scope, receive, send)
    assert messages[0]["status"] == 413
    assert received == 0


async def test_an_unannounced_length_is_refused_as_soon_as_it_is_exceeded(bench: Bench) -> None:
    """A chunked body is cut off at the limit, however long it would go on."""
    received = 0

    async def receive() -> dict[str, object]:
        nonlocal received
        received += 1
        return {"type": "http.request", "body": bytes(100_000), "more_body": True}

    messages: list[dict[str, object]] = []

    async def send(message: dict[str, object]) -> None:
        messages.append(message)

    scope = {
        "type": "http",
        "http_version": "1.1",
        "method": "POST",
        "path": "/v1/estimate",
        "raw_path": b"/v1/estimate",
        "query_string": b"",
        "headers": [],
    }
    await bench.app(scope, receive, send)
    assert messages[0]["status"] == 413
    assert received == 4


async def test_the_limit_is_named(client: httpx.AsyncClient) -> None:
    """Whoever runs the service reads which setting to raise."""
    problem = (await client.post("/v1/correct", content=chunks(5, 100_000, []))).json()
    assert problem["setting"] == "body_bytes"
    assert problem["allowed"] == f"{LIMIT} bytes"


async def test_a_form_is_limited_too(client: httpx.AsyncClient) -> None:
    """A file in a form, or a field beside it, does not get around the limit."""
    file = await client.post("/v1/correct", files={"image": bytes(LIMIT + 1)})
    field = await client.post("/v1/correct", data={"note": "x" * (LIMIT + 1)}, files={"image": b"x"})
    assert file.status_code == field.status_code == 413


@pytest.mark.parametrize(
    ("content_type", "body"),
    [
        ("multipart/form-data", b"no boundary"),
        ("multipart/form-data; boundary=x", b"--y\r\nnonsense"),
        ("multipart/form-data; boundary=x", b"--x\r\nContent-Disposition: form-data\r\n\r\nvalue\r\n--x--\r\n"),
    ],
)
async def test_a_broken_form_is_named(client: httpx.AsyncClient, content_type: str, body: bytes) -> None:
    """A form that cannot be read is the sender's problem, in words."""
    response = await client.post("/v1/correct", content=body, headers={"content-type": content_type})
    assert response.status_code in (400, 422)
    assert "form" in response.json()["detail"]


async def test_a_form_without_a_file_is_named(client: httpx.AsyncClient) -> None:
    """The answer says how the field is to be called."""
    response = await client.post("/v1/correct", files={"picture": b"x"})
    assert response.status_code == 422
    assert "image or file" in response.json()["allowed"]


async def test_a_caller_who_leaves_is_counted_apart(bench: Bench) -> None:
    """A connection that closes while the body is sent is no failure of the service."""

    async def receive() -> dict[str, object]:
        return {"type": "http.disconnect"}

    async def send(message: dict[str, object]) -> None:
        pass

    scope = {
        "type": "http",
        "http_version": "1.1",
        "method": "POST",
        "path": "/v1/correct",
        "raw_path": b"/v1/correct",
        "query_string": b"",
        "headers": [],
    }
    await bench.app(scope, receive, send)
    assert 'code="499"' in (await bench.client.get("/metrics")).text
