"""A real server process's HTTP side, against callers who send too much, too slowly, or do not read."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

import pytest
import uvicorn

from unbend_service.settings import Settings
from unbend_service.transport.rest.connections import guarded_protocol

from .conftest import Bench

SETTINGS = Settings(
    grid_points=17,
    body_bytes=300_000,
    http_connections=4,
    http_header_bytes=2048,
    http_header_s=0.3,
    http_stall_s=0.4,
)
GET = b"GET /livez HTTP/1.1\r\nHost: x\r\n"


@pytest.fixture
async def port() -> AsyncIterator[int]:
    bench = Bench(SETTINGS)
    await bench.service.start()
    config = uvicorn.Config(
        bench.app, port=0, http=guarded_protocol(SETTINGS), lifespan="off", log_config=None, ws="none"
    )
    server = uvicorn.Server(config)
    serving = asyncio.create_task(server._serve())
    while not server.started:  # noqa: ASYNC110  # uvicorn tells nobody
        await asyncio.sleep(0.01)
    yield server.servers[0].sockets[0].getsockname()[1]
    server.should_exit = True
    await serving
    await bench.close()


@asynccontextmanager
async def connection(port: int) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    try:
        yield reader, writer
    finally:
        writer.close()
        with suppress(ConnectionError):
            await writer.wait_closed()


async def answer_of(reader: asyncio.StreamReader) -> tuple[int, dict[str, object]]:
    """Status and problem of an answer that ends its connection."""
    raw = await asyncio.wait_for(reader.read(), 5)
    head, _, body = raw.partition(b"\r\n\r\n")
    return int(head.split()[1]), json.loads(body)


async def test_a_request_that_never_comes_is_not_waited_for(port: int) -> None:
    """A connection that says nothing is closed."""
    async with connection(port) as (reader, _):
        started = time.monotonic()
        assert await asyncio.wait_for(reader.read(), 5) == b""
        assert time.monotonic() - started < 2


async def test_headers_that_trickle_are_given_up(port: int) -> None:
    """A byte now and then does not hold a connection."""
    status, problem = await answer_to_trickle(port, GET, b"X-A: b\r\n")
    assert (status, problem["code"], problem["setting"]) == (408, "request_stalled", "http_header_s")


async def answer_to_trickle(port: int, first: bytes, then: bytes) -> tuple[int, dict[str, object]]:
    """What comes back while ``then`` is sent again and again; an answer may be lost when it crosses with a piece."""
    for _ in range(10):
        async with connection(port) as (reader, writer):
            writer.write(first)

            async def trickle(writer: asyncio.StreamWriter = writer) -> None:
                with suppress(ConnectionError):
                    while True:
                        writer.write(then)
                        await writer.drain()
                        await asyncio.sleep(0.05)

            trickling = asyncio.create_task(trickle())
            try:
                return await answer_of(reader)
            except ConnectionError:
                continue
            finally:
                trickling.cancel()
    raise AssertionError("no answer came through")


async def test_the_next_request_of_a_connection_has_its_clock_too(port: int) -> None:
    """One good request buys no patience for the next."""
    async with connection(port) as (reader, writer):
        writer.write(GET + b"\r\n")
        assert b"200 OK" in await reader.readuntil(b"\r\n\r\n")
        writer.write(GET)
        rest = await asyncio.wait_for(reader.read(), 5)
        assert b"408" in rest


@pytest.mark.parametrize(
    "flood",
    [
        GET + b"X-Long: " + b"x" * 5000,
        GET + b"X-Long: " + b"x" * 5000 + b"\r\n\r\n",
        GET + b"".join(b"X-%d: yyyyyyyy\r\n" % i for i in range(500)) + b"\r\n",
        b"GET /livez?" + b"q" * 5000 + b" HTTP/1.1\r\nHost: x\r\n\r\n",
    ],
    ids=["unfinished", "one", "many", "query"],
)
async def test_headers_are_bounded(port: int, flood: bytes) -> None:
    """Neither many headers nor a long one are kept in memory."""
    async with connection(port) as (reader, writer):
        writer.write(flood)
        raw = await asyncio.wait_for(reader.read(), 5)
        assert raw.split()[1] in (b"431", b"400")


@pytest.mark.parametrize(
    "padding",
    [b"1;x=" + b"y" * 5000 + b"\r\nz\r\n", b"0\r\nX-Trailer: " + b"t" * 5000],
    ids=["extension", "trailer"],
)
async def test_what_stands_around_a_body_is_bounded(port: int, padding: bytes) -> None:
    """Chunk extensions and trailers are no way around the limits."""
    async with connection(port) as (reader, writer):
        writer.write(b"POST /v1/estimate HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n")
        await asyncio.sleep(0.05)
        writer.write(padding)
        raw = await asyncio.wait_for(reader.read(), 5)
        assert raw.split()[1] in (b"431", b"400")


async def test_a_body_that_trickles_is_given_up(port: int) -> None:
    """Announcing much and sending little ends in 408, by name."""
    head = b"POST /v1/estimate HTTP/1.1\r\nHost: x\r\nContent-Length: 200000\r\n\r\n"
    status, problem = await answer_to_trickle(port, head, b"x" * 100)
    assert (status, problem["code"], problem["setting"]) == (408, "request_stalled", "http_stall_s")


async def test_a_body_after_its_answer_is_not_read_for_ever(port: int) -> None:
    """A refused upload that goes on trickling loses its connection."""
    async with connection(port) as (reader, writer):
        writer.write(b"POST /v1/estimate HTTP/1.1\r\nHost: x\r\nContent-Length: 9000000\r\n\r\n")
        assert b"413" in await reader.readuntil(b"\r\n\r\n")
        with suppress(ConnectionError):
            for _ in range(40):
                writer.write(b"x")
                await writer.drain()
                await asyncio.sleep(0.02)
        with suppress(ConnectionError):
            assert await asyncio.wait_for(reader.read(), 2) is not None
        assert writer.transport.is_closing() or reader.at_eof()


async def test_connections_are_bounded(port: int) -> None:
    """One too many is told so, and those that are open go on."""
    async with connection(port) as (reader, writer), connection(port), connection(port), connection(port):
        await asyncio.sleep(0.05)
        async with connection(port) as (refused, _):
            status, problem = await answer_of(refused)
            assert (status, problem["setting"]) == (503, "http_connections")
        writer.write(GET + b"Connection: close\r\n\r\n")
        assert b"200 OK" in await asyncio.wait_for(reader.read(), 5)


async def test_an_answer_that_nobody_reads_is_given_up(port: int) -> None:
    """A caller who stops reading does not keep answers in memory."""
    async with connection(port) as (reader, writer):
        for _ in range(400):  # the page's samples fill every buffer on the way
            writer.write(b"GET /web/samples/facade.jpg HTTP/1.1\r\nHost: x\r\n\r\n")
        with suppress(ConnectionError, TimeoutError):
            await asyncio.wait_for(writer.drain(), 1)
        transport = writer.transport
        transport.pause_reading()  # type: ignore[attr-defined]  # a reading transport, typed as a writing one
        await asyncio.sleep(2)
        transport.resume_reading()  # type: ignore[attr-defined]  # as above

        async def read_on() -> None:
            while True:
                await asyncio.wait_for(reader.readexactly(65536), 5)

        with pytest.raises((ConnectionError, asyncio.IncompleteReadError)):
            await read_on()
