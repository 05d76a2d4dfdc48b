"""Sends cases to a service and says what is wrong with the answers."""

from __future__ import annotations

import asyncio
from contextlib import suppress

import grpc

from tests.fuzz.cases import Case, GrpcCase, HttpCase
from unbend.v1 import correction_pb2

_PATIENCE_S = 60.0
#: What was sent may be half a request: nobody will answer it, and the connection is given up.
_RAW_PATIENCE_S = 0.2
_FAILURES = (grpc.StatusCode.INTERNAL, grpc.StatusCode.UNKNOWN)
#: What grpc.aio makes up for a call that the server ends while the client still sends, in place of the server's status
#: (grpc/grpc#36066); no server sends it.
_STATUS_LOST = "Internal error from Core"
_TRIES = 8
_FRAME_FAILURES = ("internal", "render_failed", "poison_frame")


class HttpSender:
    """One connection, kept alive for as long as the service keeps it."""

    def __init__(self, address: str) -> None:
        self._host, _, port = address.rpartition(":")
        self._port = int(port)
        self._reader: asyncio.StreamReader | None = None
        self._writer: asyncio.StreamWriter | None = None

    async def send(self, case: HttpCase) -> str | None:
        """What is wrong with the answer; None if nothing is, or if there is none to be had."""
        for _ in range(3):
            if self._writer is None or self._writer.is_closing():
                self._reader, self._writer = await asyncio.open_connection(self._host, self._port)
            assert self._reader is not None
            try:
                self._writer.write(case.wire)
                await self._writer.drain()
                patience_s = _RAW_PATIENCE_S if case.raw else _PATIENCE_S
                status, detail = await asyncio.wait_for(_answer(self._reader, case), patience_s)
            except TimeoutError:
                await self.close()
                return None if case.raw else f"no answer within {_PATIENCE_S} s"
            except (ConnectionError, asyncio.IncompleteReadError, ValueError):
                await self.close()
                if case.raw:
                    return None
                continue  # it was closed between two requests, or before all of the body was read
            if case.raw or detail is None:
                await self.close()
            return f"HTTP {status}: {detail!r}" if status >= 500 else None
        return None

    async def close(self) -> None:
        if self._writer is not None:
            self._writer.close()
            with suppress(OSError):
                await self._writer.wait_closed()
        self._writer = None


async def _answer(reader: asyncio.StreamReader, case: HttpCase) -> tuple[int, bytes | None]:
    """Status, and the body; None for one that ends with the connection."""
    head = await reader.readuntil(b"\r\n\r\n")
    status = int(head.split(None, 2)[1])
    if status == 100:
        return await _answer(reader, case)
    headers = dict(line.lower().split(b": ", 1) for line in head.split(b"\r\n")[1:] if b": " in line)
    if case.head.startswith(b"HEAD") or status in (204, 304):
        return status, b"" if b"close" not in headers.get(b"connection", b"") else None
    body = await reader.readexactly(int(headers.get(b"content-length", b"0")))
    if b"close" in headers.get(b"connection", b""):
        return status, body[:300] if status >= 500 else None
    return status, body[:300]


class GrpcSender:
    """One channel."""

    def __init__(self, address: str) -> None:
        options = [("grpc.max_receive_message_length", -1), ("grpc.use_local_subchannel_pool", 1)]
        self._channel = grpc.aio.insecure_channel(address, options=options)

    async def send(self, case: GrpcCase) -> str | None:
        """As :meth:`HttpSender.send`."""
        wrong = None
        for _ in range(_TRIES):
            wrong = await self._asked(case)
            if wrong is None or _STATUS_LOST not in wrong:
                break
        return wrong

    async def _asked(self, case: GrpcCase) -> str | None:
        try:
            if case.streaming:
                return await self._stream(case)
            await self._channel.unary_unary(case.method, bytes, bytes)(case.messages[0], timeout=_PATIENCE_S)
        except grpc.aio.AioRpcError as error:
            if error.code() in (*_FAILURES, grpc.StatusCode.UNAVAILABLE) or (
                error.code() is grpc.StatusCode.DEADLINE_EXCEEDED and "unbend" not in str(error.trailing_metadata())
            ):
                return f"gRPC {error.code().name}: {error.details()}"
        return None

    async def _stream(self, case: GrpcCase) -> str | None:
        call = self._channel.stream_stream(case.method, bytes, bytes)(iter(case.messages), timeout=_PATIENCE_S)
        async for raw in call:
            if case.method.endswith("CorrectStream"):
                error = correction_pb2.CorrectStreamResponse.FromString(raw).result.error
                if error.code in _FRAME_FAILURES:
                    return f"frame {error.code}: {error.message}"
        return None

    async def close(self) -> None:
        await self._channel.close()


class Senders:
    """Both, for one worker of the fuzzer."""

    def __init__(self, http: str, grpc_address: str) -> None:
        self._http, self._grpc = HttpSender(http), GrpcSender(grpc_address)

    async def send(self, case: Case) -> str | None:
        if isinstance(case, HttpCase):
            return await self._http.send(case)
        return await self._grpc.send(case)

    async def close(self) -> None:
        await self._http.close()
        await self._grpc.close()
