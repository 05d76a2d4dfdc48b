"""What happens around every request: its id, the access log, the metrics, and the last catch of all errors."""

from __future__ import annotations

import re
import time
import uuid

import structlog
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from unbend_service.application.ports import Meter, Tracer
from unbend_service.application.tracing import NoTracer
from unbend_service.transport.rest import problems

REQUEST_ID_HEADER = "X-Request-Id"
_ACCEPTED_ID = re.compile(r"[A-Za-z0-9._:-]{1,128}")
_KNOWN_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "DELETE", "OPTIONS", "PATCH"})
#: Probes and scrapes come every few seconds; they are logged at debug level only.
_QUIET_PATHS = frozenset({"/livez", "/readyz", "/metrics"})
#: For how long browsers that came over TLS once never come without it.
_ONE_YEAR = "max-age=31536000"

_log = structlog.get_logger("unbend.http")


class Accounting:
    """ASGI middleware, outermost.

    Accepts ``X-Request-Id`` or makes one, logs, counts and traces each request once it is answered, and turns what
    nobody caught into a 500 that says nothing but the request id.
    """

    def __init__(self, app: ASGIApp, meter: Meter, tracer: Tracer | None = None) -> None:
        self._app = app
        self._meter = meter
        self._tracer = tracer or NoTracer()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request_id = _request_id(scope)
        scope.setdefault("state", {})["request_id"] = request_id
        status = 0
        started = time.perf_counter()

        async def send_with_id(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                headers[REQUEST_ID_HEADER] = request_id
                headers["X-Content-Type-Options"] = "nosniff"
                headers["Cross-Origin-Resource-Policy"] = "same-origin"
                if scope.get("scheme") == "https":
                    headers["Strict-Transport-Security"] = _ONE_YEAR
            await send(message)

        traceparent = Headers(scope=scope).get("traceparent")
        with (
            self._tracer.request("http", "HTTP", request_id, traceparent) as trace,
            structlog.contextvars.bound_contextvars(
                request_id=request_id, **({"trace_id": trace.trace_id} if trace.trace_id else {})
            ),
        ):
            try:
                await self._app(scope, receive, send_with_id)
            except Exception:
                _log.exception("request failed", method=scope["method"], path=scope["path"])
                if status:
                    raise  # the answer is half sent; only the server can cut the connection
                await problems.respond_internal(request_id)(scope, receive, send_with_id)
            finally:
                trace.answered(_label(scope), str(status or 500), failed=(status or 500) >= 500)
                self._account(scope, status or 500, time.perf_counter() - started)

    def _account(self, scope: Scope, status: int, seconds: float) -> None:
        self._meter.request("http", _label(scope), str(status), seconds)
        write = _log.debug if scope["path"] in _QUIET_PATHS else _log.info
        caller = {"caller": scope["state"]["caller"]} if scope["state"].get("caller") else {}
        write(
            "request",
            **caller,
            method=scope["method"],
            path=scope["path"],
            status=status,
            seconds=round(seconds, 4),
            client=(scope.get("client") or ("",))[0],
        )


def _request_id(scope: Scope) -> str:
    offered = Headers(scope=scope).get(REQUEST_ID_HEADER, "")
    return offered if _ACCEPTED_ID.fullmatch(offered) else uuid.uuid4().hex


def _label(scope: Scope) -> str:
    """``POST /v1/correct``: the route's own path, so that ids and made-up paths do not become labels."""
    method = scope["method"] if scope["method"] in _KNOWN_METHODS else "OTHER"
    path = getattr(scope.get("route"), "path", None)
    return f"{method} {path or 'other'}"
