"""Request bodies, read in chunks against the limits of size, of time, and of the memory of all of them together."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import orjson
from fastapi import Request
from starlette.datastructures import UploadFile
from starlette.formparsers import MultiPartParser
from starlette.requests import ClientDisconnect

from unbend_service.application.budget import Holding, MemoryBudget
from unbend_service.domain.errors import (
    BodyTooLarge,
    InvalidGrid,
    InvalidInput,
    InvalidOption,
    RequestStalled,
    UnbendError,
)
from unbend_service.domain.grid import MAX_POINTS
from unbend_service.settings import Settings

IMAGE_FIELDS = ("image", "file")
#: What has to come, or to go, within ``http_stall_s`` for a connection to be kept.
LEAST_PROGRESS_BYTES = 16 << 10
#: Lists and commas of the largest grid, and as many again for all that may stand beside it.
_MOST_LISTS = MAX_POINTS**2 + (1 << 16)
_MOST_COMMAS = 2 * MAX_POINTS**2 + (1 << 16)

_BINARY = {"type": "string", "format": "binary"}
#: The ``requestBody`` of OpenAPI for a picture.
IMAGE_REQUEST_BODY: dict[str, Any] = {
    "required": True,
    "description": "The image file as it is: jpeg, png, webp, tiff or bmp, told by its first bytes. "
    "A form with one file named `image` or `file` is accepted too.",
    "content": {
        **{f"image/{name}": {"schema": _BINARY} for name in ("jpeg", "png", "webp", "tiff", "bmp")},
        "application/octet-stream": {"schema": _BINARY},
        "multipart/form-data": {
            "schema": {"type": "object", "properties": {"image": _BINARY, "file": _BINARY}, "minProperties": 1}
        },
    },
}


class Bodies:
    """Reads the bodies of the routes of one application.

    Args:
        settings: ``body_bytes`` and ``http_stall_s`` bound one body.
        budget: bounds all of them together.
    """

    def __init__(self, settings: Settings, budget: MemoryBudget) -> None:
        self._limit_bytes = settings.body_bytes
        self._stall_s = settings.http_stall_s
        self._budget = budget

    @asynccontextmanager
    async def raw(self, request: Request) -> AsyncIterator[bytes]:
        """The body as it is; it counts among the bodies in memory until the end of the block.

        Raises:
            BodyTooLarge: as soon as Content-Length, or what has come so far, is over the limit.
            MemoryFull: there is no room beside the other bodies.
            RequestStalled: it comes too slowly.
        """
        with self._budget.holding() as holding:
            yield await self._read(request, holding)

    @asynccontextmanager
    async def image(self, request: Request) -> AsyncIterator[bytes]:
        """The raw body, or of a multipart form the file named ``image`` or ``file``.

        Raises:
            BodyTooLarge, MemoryFull, RequestStalled: as :meth:`raw`, counting the whole form.
            InvalidInput: a form that cannot be parsed.
            InvalidOption: a form without that file.
        """
        with self._budget.holding() as holding:
            if request.headers.get("content-type", "").lower().startswith("multipart/form-data"):
                body = await self._file(request, holding)
            else:
                body = await self._read(request, holding)
            yield body

    async def _read(self, request: Request, holding: Holding) -> bytes:
        body = bytearray()
        async for chunk in _bounded(request, self._limit_bytes, self._stall_s, holding):
            body += chunk
        return bytes(body)

    async def _file(self, request: Request, holding: Holding) -> bytes:
        chunks = _bounded(request, self._limit_bytes, self._stall_s, holding)
        parser = MultiPartParser(request.headers, chunks, max_files=1, max_fields=8)
        parser.spool_max_size = self._limit_bytes + 1  # counted in memory, never written to the disk of the service
        try:
            form = await parser.parse()
        except (UnbendError, ClientDisconnect):
            raise
        except Exception as error:  # no boundary, an unknown charset, and whatever else the parser trips over
            reason = getattr(error, "message", "") or "its Content-Type or one of its parts is broken."
            raise InvalidInput(f"The form cannot be read: {reason}") from error
        try:
            for name in IMAGE_FIELDS:
                part = form.get(name)
                if isinstance(part, UploadFile):
                    return await part.read()
        finally:
            await form.close()
        raise InvalidOption("The form has no file to correct.", allowed="one file named " + " or ".join(IMAGE_FIELDS))


def parse_json(body: bytes) -> Any:
    """The value of a JSON body that has no more lists and numbers than the largest grid: each costs memory.

    Raises:
        InvalidGrid: no JSON, nested too deeply, or more than any grid needs.
    """
    if body.count(b"[") + body.count(b"{") > _MOST_LISTS or body.count(b",") > _MOST_COMMAS:
        raise InvalidGrid(
            "The body has more lists or numbers than any grid.", allowed=f"{MAX_POINTS} rows and {MAX_POINTS} columns"
        )
    try:
        return orjson.loads(body)
    except orjson.JSONDecodeError as error:
        raise InvalidGrid(
            f"The body is not JSON: {error}.", allowed="RFC 8259 JSON, which has neither NaN nor Infinity"
        ) from error


async def read_body(request: Request, limit_bytes: int) -> bytes:
    """A small body, of a page on this machine: bounded in size only. Raises BodyTooLarge."""
    return b"".join([chunk async for chunk in _bounded(request, limit_bytes, None, None)])


async def _bounded(
    request: Request, limit_bytes: int, stall_s: float | None, holding: Holding | None
) -> AsyncGenerator[bytes, None]:
    announced = request.headers.get("content-length", "")
    if announced.isdecimal():
        announced_bytes = int(announced.lstrip("0")[:20] or "0")
        if announced_bytes > limit_bytes:
            raise _too_large(limit_bytes)
        if holding is not None:
            holding.expect(announced_bytes)
    size_bytes = 0
    clock = asyncio.get_running_loop().time
    counted_bytes, counted_s = 0, clock()
    stream = request.stream()
    while True:
        try:
            async with asyncio.timeout_at(None if stall_s is None else counted_s + stall_s):
                chunk = await anext(stream, None)
        except TimeoutError:
            raise RequestStalled(
                f"The body brought {size_bytes - counted_bytes} bytes in {stall_s:g} s.",
                allowed=f"{LEAST_PROGRESS_BYTES} bytes in that time",
                setting="http_stall_s",
            ) from None
        if chunk is None:
            return
        size_bytes += len(chunk)
        if size_bytes > limit_bytes:
            raise _too_large(limit_bytes)
        if size_bytes - counted_bytes >= LEAST_PROGRESS_BYTES:
            counted_bytes, counted_s = size_bytes, clock()
        if holding is not None:
            holding.grow(len(chunk))
        yield chunk


def _too_large(limit_bytes: int) -> BodyTooLarge:
    return BodyTooLarge("The body is too large.", allowed=f"{limit_bytes} bytes", setting="body_bytes")
