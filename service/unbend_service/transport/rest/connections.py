"""What a connection may cost before and after the application sees its request.

Uvicorn's parser has no bound on the headers of a request and no clock on a caller who sends or reads slowly; here both
are added around it.
"""

from __future__ import annotations

import asyncio
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from unbend_service.settings import Settings
from unbend_service.transport.rest.bodies import LEAST_PROGRESS_BYTES
from unbend_service.transport.rest.problems import raw_problem

#: Bytes on the wire for each byte of a body in chunks, at the very most; the rest is padding, extensions and trailers.
_CHUNK_OVERHEAD = 16


class _GuardedProtocol(HttpToolsProtocol):
    """One connection, with its limits. ``settings`` is set by :func:`guarded_protocol`."""

    settings: Settings

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._reading_headers = True
        self._reading_body = False
        self._header_bytes = 0
        self._raw_bytes = 0
        self._clock: asyncio.TimerHandle | None = None
        self._write_clock: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as in uvicorn
        super().connection_made(transport)
        if len(self.connections) > self.settings.http_connections:
            self._refuse(503, "unavailable", "Too many connections are open.", "http_connections")
            return
        self._start_clock()

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_clock()
        if self._write_clock is not None:
            self._write_clock.cancel()
            self._write_clock = None
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        if self.transport.is_closing():
            return
        if self._clock is None and self._reading_headers:  # the next request of a connection that was kept
            self._start_clock()
        # the parser keeps an unfinished header to itself: only the raw bytes tell its size
        self._raw_bytes += len(data)
        super().data_received(data)
        if self.transport.is_closing():
            return
        if max(self._header_bytes, self._raw_bytes) > self.settings.http_header_bytes:
            self._refuse(431, "invalid_input", "The request line and headers are too large.", "http_header_bytes")

    def on_message_begin(self) -> None:
        super().on_message_begin()
        self._header_bytes = 0

    def on_url(self, url: bytes) -> None:
        self._header_bytes += len(url)
        super().on_url(url)

    def on_header(self, name: bytes, value: bytes) -> None:
        self._header_bytes += len(name) + len(value)
        if self._header_bytes > self.settings.http_header_bytes:
            return  # of a request, or trailers after its body: not kept, and refused once the parser returns
        super().on_header(name, value)

    def on_headers_complete(self) -> None:
        if self._header_bytes > self.settings.http_header_bytes:
            raise ValueError("headers too large")
        self._stop_clock()
        self._raw_bytes = 0
        self._reading_headers, self._reading_body = False, True
        super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        self._raw_bytes -= _CHUNK_OVERHEAD * len(body)
        super().on_body(body)

    def on_message_complete(self) -> None:
        self._reading_headers, self._reading_body = True, False
        self._header_bytes = self._raw_bytes = 0
        super().on_message_complete()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        if self._reading_body and not self.transport.is_closing():
            self._start_clock()  # answered early: the rest of the body is read past, but not for ever

    def pause_writing(self) -> None:
        super().pause_writing()
        self._watch_writing(self.transport.get_write_buffer_size())

    def resume_writing(self) -> None:
        super().resume_writing()
        if self._write_clock is not None:
            self._write_clock.cancel()
            self._write_clock = None

    def _watch_writing(self, left_bytes: int) -> None:
        def look() -> None:
            left_now_bytes = self.transport.get_write_buffer_size()
            if left_bytes - left_now_bytes < LEAST_PROGRESS_BYTES:
                self.transport.abort()
            else:
                self._watch_writing(left_now_bytes)

        if self._write_clock is not None:
            self._write_clock.cancel()
        self._write_clock = self.loop.call_later(self.settings.http_stall_s, look)

    def _start_clock(self) -> None:
        self._stop_clock()
        self._clock = self.loop.call_later(self.settings.http_header_s, self._time_out)

    def _stop_clock(self) -> None:
        if self._clock is not None:
            self._clock.cancel()
            self._clock = None

    def _time_out(self) -> None:
        self._clock = None
        if self.transport.is_closing():
            return
        if self._reading_body or not self._raw_bytes:  # answered already, or nothing was asked
            self.transport.close()
        elif self.cycle is None or self.cycle.response_complete:
            self._refuse(408, "request_stalled", "The request line and headers did not come.", "http_header_s")
        else:
            self.transport.close()

    def _refuse(self, status: int, code: str, detail: str, setting: str) -> None:
        self._stop_clock()
        if not (self._reading_body and self.cycle.response_started):
            self.transport.write(raw_problem(status, code, detail, setting))
        self.transport.close()


def guarded_protocol(settings: Settings) -> type[asyncio.Protocol]:
    """The protocol class for uvicorn's ``http``, with the limits of ``settings``: ``http_connections``,
    ``http_header_bytes``, ``http_header_s`` and ``http_stall_s``."""
    return type("GuardedProtocol", (_GuardedProtocol,), {"settings": settings})
