"""Request bodies, read in chunks against the limit."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from typing import Any

from fastapi import Request
from starlette.datastructures import UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser

from unbend_service.domain.errors import BodyTooLarge, InvalidInput, InvalidOption

IMAGE_FIELDS = ("image", "file")

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


async def read_body(request: Request, limit_bytes: int) -> bytes:
    """The raw body.

    Raises:
        BodyTooLarge: as soon as Content-Length, or what has come so far, is over ``limit_bytes``.
    """
    body = bytearray()
    async for chunk in _bounded(request, limit_bytes):
        body += chunk
    return bytes(body)


async def read_image(request: Request, limit_bytes: int) -> bytes:
    """The raw body, or of a multipart form the file named ``image`` or ``file``.

    Raises:
        BodyTooLarge: as :func:`read_body`, counting the whole form.
        InvalidInput: a form that cannot be parsed.
        InvalidOption: a form without that file.
    """
    if not request.headers.get("content-type", "").lower().startswith("multipart/form-data"):
        return await read_body(request, limit_bytes)
    parser = MultiPartParser(request.headers, _bounded(request, limit_bytes), max_files=1, max_fields=8)
    try:
        form = await parser.parse()
    except BodyTooLarge:
        raise
    except MultiPartException as error:
        raise InvalidInput(f"The form cannot be read: {error.message}") from error
    except (KeyError, ValueError) as error:  # no boundary, or an unknown charset
        raise InvalidInput("The form cannot be read: its Content-Type is broken.") from error
    try:
        for name in IMAGE_FIELDS:
            part = form.get(name)
            if isinstance(part, UploadFile):
                return await part.read()
    finally:
        await form.close()
    raise InvalidOption("The form has no file to correct.", allowed="one file named " + " or ".join(IMAGE_FIELDS))


async def _bounded(request: Request, limit_bytes: int) -> AsyncGenerator[bytes, None]:
    announced = request.headers.get("content-length", "")
    if announced.isdecimal() and int(announced) > limit_bytes:
        raise _too_large(limit_bytes)
    size_bytes = 0
    async for chunk in request.stream():
        size_bytes += len(chunk)
        if size_bytes > limit_bytes:
            raise _too_large(limit_bytes)
        yield chunk


def _too_large(limit_bytes: int) -> BodyTooLarge:
    return BodyTooLarge("The body is too large.", allowed=f"{limit_bytes} bytes", setting="body_bytes")
