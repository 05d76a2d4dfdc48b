from __future__ import annotations

from collections.abc import AsyncIterator

import httpx
import pytest

from unbend_service.domain.errors import InvalidGrid
from unbend_service.transport.rest.bodies import parse_json

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


async def test_bodies_share_the_memory_for_bodies(bench: Bench, jpeg: bytes) -> None:
    """A body too many is told to come again, and what was held is free afterwards."""
    budget = bench.service.bodies
    with budget.holding() as holding:
        holding.grow(bench.settings.bodies_bytes - len(jpeg) + 1)
        announced = await bench.client.post("/v1/estimate", content=jpeg)
        unannounced = await bench.client.post("/v1/estimate", content=pieces(jpeg))
        form = await bench.client.post("/v1/estimate", files={"image": jpeg})
    for refused in (announced, unannounced, form):
        assert refused.status_code == 429
        assert refused.json()["setting"] == "bodies_bytes"
        assert int(refused.headers["retry-after"]) >= 1
    assert (await bench.client.post("/v1/estimate", content=jpeg)).status_code == 200
    assert budget.used_bytes == 0


async def pieces(body: bytes) -> AsyncIterator[bytes]:
    for first in range(0, len(body), 1000):
        yield body[first : first + 1000]


@pytest.mark.parametrize(
    "body",
    [b"[" * 1_200_000, b"[" + b"0," * 2_300_000 + b"0]", b"{" * 2000, b"[" * 100_000 + b"]" * 100_000],
    ids=["lists", "numbers", "objects", "deep"],
)
def test_json_is_bounded_before_it_is_parsed(body: bytes) -> None:
    """Lists in lists, and more numbers than any grid has, cost neither memory nor the stack."""
    with pytest.raises(InvalidGrid):
        parse_json(body)


@pytest.mark.parametrize("charset", ["hex", "rot13", "zlib", "undefined", "idna", '""', "utf-16"])
async def test_an_odd_charset_of_a_form_is_named_or_ignored(client: httpx.AsyncClient, charset: str) -> None:
    """Python knows charsets that are none; no form may reach them."""
    body = b'--x\r\nContent-Disposition: form-data; name="\xff\xfe."\r\n\r\n\xff..a\xc3\r\n--x--\r\n'
    response = await client.post(
        "/v1/correct", content=body, headers={"content-type": f"multipart/form-data; boundary=x; charset={charset}"}
    )
    assert response.status_code in (400, 422)
