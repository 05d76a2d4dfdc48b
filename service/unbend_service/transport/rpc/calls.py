"""Around every call: parsing, admission, errors, metrics, request ids."""

from __future__ import annotations

import asyncio
import secrets
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
from contextvars import ContextVar
from typing import Any

import grpc
import structlog

from unbend_service.application.access import Permit
from unbend_service.application.service import Service
from unbend_service.domain.access import Scope
from unbend_service.domain.errors import UnbendError
from unbend_service.transport.rpc.messages import parse, parse_all
from unbend_service.transport.rpc.scopes import SCOPES, token_of
from unbend_service.transport.rpc.status import INTERNAL, Status, status_of

log = structlog.get_logger(__name__)

_OURS = "/unbend.v1."
_REQUEST_ID = "x-request-id"
_FAULTS = frozenset({grpc.StatusCode.INTERNAL, grpc.StatusCode.UNKNOWN, grpc.StatusCode.UNAVAILABLE})

#: A reader who takes nothing for so long learns of the end of his stream from his own deadline.
_WRITE_PATIENCE_S = 1.0

Context = grpc.aio.ServicerContext[Any, Any]

_PERMIT: ContextVar[Permit | None] = ContextVar("permit", default=None)


class SettlingContext:
    """The context of a stream whose writes go through even when their writer is cancelled.

    gRPC takes no status while a write is under way: the caller of a stream that ended in that moment would wait for
    ever. Everything but writing and ending is the context's own.
    """

    def __init__(self, context: Context) -> None:
        self._context = context
        self._write: asyncio.Future[None] | None = None

    async def write(self, message: Any) -> None:
        """As the context's, one at a time."""
        self._write = asyncio.ensure_future(self._context.write(message))
        self._write.add_done_callback(_seen)
        await asyncio.shield(self._write)

    async def abort(self, *status: Any) -> Any:
        """As the context's, once the last write is through, or its reader has had time enough."""
        if self._write is not None and not self._write.done():
            await asyncio.wait({self._write}, timeout=_WRITE_PATIENCE_S)
        return await self._context.abort(*status)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._context, name)


def _seen(write: asyncio.Future[None]) -> None:
    if not write.cancelled():
        write.exception()  # told to the writer, if he is still there


class CallInterceptor(grpc.aio.ServerInterceptor):  # type: ignore[type-arg] # generic in its stubs only
    """Lets calls in, and wraps every method: its messages are parsed here; what else is said holds for unbend.v1.

    Servicers raise errors of the application; here they become statuses. A request id is taken from the metadata
    (``x-request-id``) or made, bound to the log lines of the call, and sent back in the trailing metadata. The message
    of a unary call counts among the request bodies in memory for as long as the call lasts.
    """

    def __init__(self, service: Service) -> None:
        self._service = service

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[grpc.RpcMethodHandler[Any, Any]]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> grpc.RpcMethodHandler[Any, Any]:
        handler = await continuation(handler_call_details)
        if handler is None:
            return handler
        method = handler_call_details.method
        name = method.removeprefix(_OURS).removeprefix("/")
        request_id = _request_id(handler_call_details)
        scope = SCOPES.get(method, Scope.ADMIN)
        try:
            permit = self._service.access.admit(token_of(handler_call_details), scope) if scope is not None else None
        except UnbendError as error:
            return self._refusing(name, request_id, error)
        if permit is None or not method.startswith(_OURS):
            return _parsing(method, handler)
        parser: Any = handler.request_deserializer
        if handler.unary_unary is not None:
            unary: Any = handler.unary_unary  # asynchronous, which the stubs do not know

            async def call(raw: bytes, context: Any) -> Any:
                with self._service.bodies.holding() as holding:
                    holding.grow(len(raw))
                    return await unary(parse(method, parser, raw), context)

            async def answer(raw: bytes, context: Any) -> Any:
                return await self._watched(name, request_id, context, call(raw, context), permit, single=True)

            return grpc.unary_unary_rpc_method_handler(answer, None, handler.response_serializer)
        stream: Any = handler.stream_stream

        async def converse(raws: Any, context: Any) -> None:
            requests, settling = parse_all(method, parser, raws), SettlingContext(context)
            work = self._stream(permit, stream, requests, settling)
            await self._watched(name, request_id, settling, work, permit)

        return grpc.stream_stream_rpc_method_handler(converse, None, handler.response_serializer)

    async def _stream(self, permit: Permit, stream: Any, requests: Any, context: SettlingContext) -> None:
        with self._service.access.stream(permit):
            await stream(requests, context)

    def _refusing(self, name: str, request_id: str, error: UnbendError) -> grpc.RpcMethodHandler[Any, Any]:
        """Ends a call before anything of it is read; whatever kind of call it is, an end looks the same."""

        async def refuse(requests: Any, context: Any) -> None:
            await self._watched(name, request_id, context, _raised(error))

        return grpc.stream_stream_rpc_method_handler(refuse)

    async def _watched(
        self,
        name: str,
        request_id: str,
        context: Context | SettlingContext,
        work: Awaitable[Any],
        permit: Permit | None = None,
        *,
        single: bool = False,
    ) -> Any:
        traceparent = _sent(context.invocation_metadata(), "traceparent")
        with (
            self._service.tracer.request("grpc", name, request_id, traceparent) as trace,
            structlog.contextvars.bound_contextvars(
                request_id=request_id, method=name, **_named(permit), **_traced(trace.trace_id)
            ),
        ):
            start, code = time.perf_counter(), grpc.StatusCode.CANCELLED
            _PERMIT.set(permit)
            try:
                result, status = await self._outcome(work, single)
                code = grpc.StatusCode.OK if status is None else status.code
            finally:  # before the client knows, so that it sees its call counted
                seconds = time.perf_counter() - start
                self._service.meter.request("grpc", name, code.name, seconds)
                trace.answered(name, code.name, failed=code in _FAULTS)
                log.info("request", code=code.name, seconds=round(seconds, 4))
        if status is None:
            context.set_trailing_metadata(((_REQUEST_ID, request_id),))
            return result
        return await context.abort(status.code, status.message, (*status.trailing_metadata, (_REQUEST_ID, request_id)))

    async def _outcome(self, work: Awaitable[Any], single: bool) -> tuple[Any, Status | None]:
        """What a call returned, or the status that it ends with; at the caller's deadline grpc cancels it."""
        admitted = False
        try:
            with self._service.admission.admitted(single=single):
                admitted = True
                return await work, None
        except UnbendError as error:
            if not admitted:
                self._service.meter.rejected(error.code)
            status = status_of(error)
            log.info("refused", code=error.code, message=str(error))
            return None, status
        except grpc.aio.AbortError:
            raise
        except Exception:
            log.exception("failed")
            return None, INTERNAL
        finally:
            if not admitted and asyncio.iscoroutine(work):
                work.close()


def permitted() -> Permit:
    """Of the call that is being answered."""
    permit = _PERMIT.get()
    if permit is None:
        raise RuntimeError("nobody was let in")
    return permit


def _named(permit: Permit | None) -> dict[str, str]:
    return {"caller": permit.caller.name} if permit is not None and permit.caller.name else {}


async def _raised(error: UnbendError) -> None:
    raise error


def _parsing(method: str, handler: grpc.RpcMethodHandler[Any, Any]) -> grpc.RpcMethodHandler[Any, Any]:
    """The same handler, to which a broken message is the caller's error; of health and reflection."""
    parser: Any = handler.request_deserializer
    behaviour: Any = handler.unary_unary or handler.unary_stream or handler.stream_stream

    async def parsed(raw: bytes, context: Context) -> Any:
        try:
            return parse(method, parser, raw)
        except UnbendError as error:
            status = status_of(error)
            return await context.abort(status.code, status.message, status.trailing_metadata)

    async def parsed_all(raws: AsyncIterator[bytes], context: Context) -> AsyncIterator[Any]:
        async for raw in raws:
            yield await parsed(raw, context)

    if handler.request_streaming:

        async def converse(raws: Any, context: Any) -> AsyncIterator[Any]:
            async for response in behaviour(parsed_all(raws, context), context):
                yield response

        return grpc.stream_stream_rpc_method_handler(converse, None, handler.response_serializer)

    async def answer(raw: bytes, context: Any) -> Any:
        return await behaviour(await parsed(raw, context), context)

    if handler.response_streaming:
        return grpc.unary_stream_rpc_method_handler(answer, None, handler.response_serializer)
    return grpc.unary_unary_rpc_method_handler(answer, None, handler.response_serializer)


def _traced(trace_id: str) -> dict[str, str]:
    return {"trace_id": trace_id} if trace_id else {}


def _sent(metadata: Iterable[tuple[str, str | bytes]] | None, name: str) -> str | None:
    return next((value for key, value in metadata or () if key == name and isinstance(value, str)), None)


def _request_id(details: grpc.HandlerCallDetails) -> str:
    sent = _sent(details.invocation_metadata, _REQUEST_ID)
    return sent if sent is not None and 0 < len(sent) <= 128 else secrets.token_hex(8)
