"""Calls of the API are let in one by one, held to the time of their caller, and given up when he is gone."""

from __future__ import annotations

import asyncio
import math

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from unbend_service.application.admission import Admission
from unbend_service.application.deadlines import deadline
from unbend_service.application.ports import Meter
from unbend_service.domain.errors import InvalidOption, UnbendError
from unbend_service.transport.rest import problems

TIMEOUT_HEADER = "Unbend-Timeout-S"
_LONGEST_S = 3600.0


class Admitting:
    """ASGI middleware: a draining service refuses new calls, a full one refuses one more.

    ``Unbend-Timeout-S`` says how many seconds the answer is worth waiting for: after that the work is cancelled, at
    whatever stage it is. So it is when the caller closes his connection.
    """

    def __init__(self, app: ASGIApp, admission: Admission, meter: Meter) -> None:
        self._app = app
        self._admission = admission
        self._meter = meter

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or not scope["path"].startswith("/v1/"):
            await self._app(scope, receive, send)
            return
        admitted = started = False

        async def noting(message: Message) -> None:
            nonlocal started
            started = True
            await parting(message)

        async def parting(message: Message) -> None:
            """Before a service goes, callers are asked to close: no request of theirs meets a closed connection."""
            if message["type"] == "http.response.start" and self._admission.leaving:
                MutableHeaders(scope=message)["Connection"] = "close"
            await send(message)

        try:
            left_s = _time_given(Headers(scope=scope))
            with self._admission.admitted(single=True):
                admitted = True
                async with deadline(left_s):
                    await self._watched(scope, receive, noting)
        except UnbendError as error:
            if started:
                raise  # the answer is half sent; only the server can cut the connection
            if not admitted:
                self._meter.rejected(error.code)
            await problems.respond_to(error, scope["state"]["request_id"])(scope, receive, parting)

    async def _watched(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Runs the call until its caller is gone."""
        caller = _Caller(receive, send)
        try:
            await self._app(scope, caller.receive, caller.send)
        except asyncio.CancelledError:
            task = asyncio.current_task()
            if not caller.gone or task is None or task.uncancel() > 0:
                raise
            await Response(status_code=problems.CLIENT_CLOSED_REQUEST)(scope, receive, send)
        finally:
            caller.stop()


class _Caller:
    """The caller of one request: once its body is read, his going cancels the task that made this.

    Attributes:
        gone: whether it did.
    """

    def __init__(self, receive: Receive, send: Send) -> None:
        self._receive = receive
        self._send = send
        self._owner = asyncio.current_task()
        self._watching: asyncio.Task[None] | None = None
        self.gone = False

    async def receive(self) -> Message:
        if self._watching is not None:
            await asyncio.shield(self._watching)
            return {"type": "http.disconnect"}
        message = await self._receive()
        if message["type"] == "http.request" and not message.get("more_body"):
            self._watching = asyncio.create_task(self._watch())
        return message

    async def send(self, message: Message) -> None:
        self.stop()  # there is nothing left to be given up
        await self._send(message)

    def stop(self) -> None:
        """Looks after him no longer."""
        if self._watching is not None and not self.gone:
            self._watching.cancel()

    async def _watch(self) -> None:
        while (await self._receive())["type"] != "http.disconnect":
            pass
        self.gone = True
        if self._owner is not None:
            self._owner.cancel()


def _time_given(headers: Headers) -> float | None:
    given = headers.get(TIMEOUT_HEADER)
    if given is None:
        return None
    try:
        left_s = float(given)
    except ValueError:
        left_s = math.nan
    if not 0 < left_s <= _LONGEST_S:
        raise InvalidOption(
            f"{TIMEOUT_HEADER} is {given[:32]!r}.", allowed=f"seconds, more than 0 and at most {_LONGEST_S:g}"
        )
    return left_s
