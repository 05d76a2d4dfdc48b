"""Errors as RFC 9457 problem details: the one table from Unbend's errors to HTTP status codes."""

from __future__ import annotations

import math
import uuid
from collections.abc import Iterable, Mapping
from http import HTTPStatus
from typing import Any

import orjson
from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from unbend_service.domain import errors

MEDIA_TYPE = "application/problem+json"

#: Status and title of every error class; a class that is not listed is answered as its nearest base is.
TABLE: Mapping[type[errors.UnbendError], tuple[int, str]] = {
    errors.UnbendError: (500, "Internal error"),
    errors.InvalidInput: (400, "Invalid input"),
    errors.EmptyBody: (422, "Empty body"),
    errors.InvalidImage: (422, "Invalid image"),
    errors.TooManyPixels: (422, "Too many pixels"),
    errors.ImageTooCostly: (422, "Image too costly"),
    errors.UnsupportedMediaType: (415, "Unsupported media type"),
    errors.BodyTooLarge: (413, "Body too large"),
    errors.InvalidOption: (422, "Invalid option"),
    errors.InvalidGuides: (422, "Invalid guides"),
    errors.InvalidGrid: (422, "Invalid grid"),
    errors.FoldedGrid: (422, "Folded grid"),
    errors.InvalidFrame: (422, "Invalid frame"),
    errors.UnsupportedPixelFormat: (422, "Unsupported pixel format"),
    errors.InvalidRegion: (422, "Invalid region"),
    errors.ProtocolViolation: (400, "Protocol violation"),
    errors.GridNotFound: (404, "Grid not found"),
    errors.RegionNotFound: (404, "Region not found"),
    errors.GridConflict: (409, "Grid conflict"),
    errors.NotServedHere: (501, "Not served here"),
    errors.Refused: (403, "Refused"),
    errors.Unauthenticated: (401, "Unauthenticated"),
    errors.PermissionDenied: (403, "Permission denied"),
    errors.Overloaded: (429, "Overloaded"),
    errors.QueueFull: (429, "Queue full"),
    errors.MemoryFull: (429, "Memory full"),
    errors.TooManyRegions: (429, "Too many regions"),
    errors.RateLimited: (429, "Rate limited"),
    errors.TooManyStreams: (429, "Too many streams"),
    errors.Unavailable: (503, "Unavailable"),
    errors.Draining: (503, "Draining"),
    errors.EstimatorUnavailable: (503, "Estimator unavailable"),
    errors.GridStoreUnavailable: (503, "Grid store unavailable"),
    errors.ModelUnavailable: (503, "Model unavailable"),
    errors.RendererUnavailable: (503, "Renderer unavailable"),
    errors.RenderFailed: (500, "Render failed"),
    errors.PoisonFrame: (500, "Poison frame"),
    errors.StreamEnded: (409, "Stream ended"),
    errors.StreamTakenOver: (409, "Stream taken over"),
    errors.StreamIdle: (408, "Stream idle"),
    errors.RequestStalled: (408, "Request stalled"),
    errors.DeadlineExceeded: (504, "Deadline exceeded"),
}

#: RFC 6750 wants the refusals of a bearer token said in a header too.
_CHALLENGES: Mapping[type[errors.UnbendError], str] = {
    errors.Unauthenticated: 'Bearer realm="unbend", error="invalid_token"',
    errors.PermissionDenied: 'Bearer realm="unbend", error="insufficient_scope"',
}
_RETRY_AFTER_S = 1
#: nginx's code for a caller who went away; nobody reads the answer, but it is counted.
CLIENT_CLOSED_REQUEST = 499


class Problem(BaseModel):
    """RFC 9457 problem details."""

    type: str = Field(description="`urn:unbend:error:` and the code.", examples=["urn:unbend:error:invalid_image"])
    title: str = Field(description="The kind of problem in words.")
    status: int = Field(description="The HTTP status code.", ge=400, le=599)
    detail: str = Field(description="What was wrong with this request.")
    code: str = Field(description="Stable name of the error, the same over HTTP and gRPC.", examples=["invalid_image"])
    allowed: str | None = Field(None, description="What would have been accepted.")
    setting: str | None = Field(None, description="The setting of the service that governs the limit.")
    request_id: str = Field(description="Of the X-Request-Id header; quote it when you ask about this request.")


def status_and_title(kind: type[errors.UnbendError]) -> tuple[int, str]:
    """The entry of TABLE for an error class."""
    return next(TABLE[base] for base in kind.__mro__ if base in TABLE)


def respond(
    request_id: str,
    status: int,
    title: str,
    code: str,
    detail: str,
    *,
    allowed: str | None = None,
    setting: str | None = None,
    headers: Mapping[str, str] | None = None,
) -> Response:
    """A problem+json response; ``allowed`` and ``setting`` are left out where nothing is to be said."""
    content: dict[str, Any] = {
        "type": f"urn:unbend:error:{code}",
        "title": title,
        "status": status,
        "detail": detail,
        "code": code,
    }
    content |= {key: value for key, value in (("allowed", allowed), ("setting", setting)) if value is not None}
    content["request_id"] = request_id
    return Response(orjson.dumps(content), status, media_type=MEDIA_TYPE, headers=headers)


def respond_to(error: errors.UnbendError, request_id: str) -> Response:
    """The response to one of Unbend's errors."""
    status, title = status_and_title(type(error))
    headers = {}
    if status in (429, 503):
        headers["Retry-After"] = str(max(_RETRY_AFTER_S, math.ceil(error.retry_after_s or 0)))
    if status == 408:
        headers["Connection"] = "close"  # the rest of the body is not waited for
    if type(error) in _CHALLENGES:
        headers["WWW-Authenticate"] = _CHALLENGES[type(error)]
    return respond(
        request_id,
        status,
        title,
        error.code,
        error.message,
        allowed=error.allowed,
        setting=error.setting,
        headers=headers,
    )


def respond_internal(request_id: str) -> Response:
    """The response to anything that nobody expected; what it was stands in the log under the request id."""
    return respond(
        request_id, 500, "Internal error", errors.UnbendError.code, "The service failed; its log knows this request id."
    )


def raw_problem(status: int, code: str, detail: str, setting: str) -> bytes:
    """A whole HTTP/1.1 answer that ends its connection, for what is refused before there is a request."""
    phrase = HTTPStatus(status).phrase
    request_id = uuid.uuid4().hex
    answer = respond(request_id, status, phrase, code, detail, setting=setting)
    answer.headers["X-Request-Id"] = request_id
    answer.headers["Connection"] = "close"
    if status == 503:
        answer.headers["Retry-After"] = str(_RETRY_AFTER_S)
    head = [f"HTTP/1.1 {status} {phrase}".encode(), *(name + b": " + value for name, value in answer.raw_headers)]
    return b"\r\n".join([*head, b"", bytes(answer.body)])


def responses(*kinds: type[errors.UnbendError]) -> dict[int | str, dict[str, Any]]:
    """The ``responses`` of a route that raises ``kinds``, and what every route may answer, for OpenAPI."""
    always = (errors.UnbendError, errors.Unauthenticated, errors.PermissionDenied, errors.RateLimited)
    titles: dict[int, list[str]] = {}
    for kind in (*kinds, *always):
        status, title = status_and_title(kind)
        if title not in titles.setdefault(status, []):
            titles[status].append(title)
    schema = {"$ref": "#/components/schemas/Problem"}
    return {
        status: {"description": "; ".join(names), "content": {MEDIA_TYPE: {"schema": schema}}}
        for status, names in sorted(titles.items())
    }


def install(app: FastAPI) -> None:
    """Answers every error that a route raises, FastAPI's own included, with a problem."""

    async def unbend_error(request: Request, error: Exception) -> Response:
        assert isinstance(error, errors.UnbendError)
        return respond_to(error, request.state.request_id)

    async def invalid_query(request: Request, error: Exception) -> Response:
        assert isinstance(error, RequestValidationError)
        title = status_and_title(errors.InvalidOption)[1]
        details = "; ".join(_sentences(error.errors()))
        return respond(request.state.request_id, 422, title, errors.InvalidOption.code, details)

    async def http_error(request: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)
        codes = {404: ("not_found", "Not found"), 405: ("method_not_allowed", "Method not allowed")}
        code, title = codes.get(error.status_code, ("http_error", "HTTP error"))
        detail = f"{request.method} {request.url.path}: {error.detail}. See /docs."
        return respond(request.state.request_id, error.status_code, title, code, detail, headers=error.headers)

    async def client_gone(request: Request, error: Exception) -> Response:
        return Response(status_code=CLIENT_CLOSED_REQUEST)

    app.add_exception_handler(errors.UnbendError, unbend_error)
    app.add_exception_handler(RequestValidationError, invalid_query)
    app.add_exception_handler(HTTPException, http_error)
    app.add_exception_handler(ClientDisconnect, client_gone)


def _sentences(found: Iterable[Mapping[str, Any]]) -> Iterable[str]:
    for each in found:
        name = ".".join(str(part) for part in each["loc"][1:])
        yield f"{name}: {each['msg']}" if name else str(each["msg"])
