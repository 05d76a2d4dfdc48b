"""Around every call: parsing, admission, errors, metrics, request ids."""

from __future__ import annotations

import asyncio
import secrets
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

import grpc
import structlog

from unbend_service.application.service import Service
from unbend_service.domain.errors import UnbendError
from unbend_service.transport.rpc.messages import parse, parse_all
from unbend_service.transport.rpc.status import INTERNAL, Status, status_of

log = structlog.get_logger(__name__)

_OURS = "/unbend.v1."
_REQUEST_ID = "x-request-id"

#: A reader who takes nothing for so long learns of the end of his stream from his own deadline.
_WRITE_PATIENCE_S = 1.0

Context = grpc.aio.ServicerContext[Any, Any]


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
    """Wraps every method: its messages are parsed here; what else is said holds for the methods of unbend.v1.

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
        if not method.startswith(_OURS):
            return _parsing(method, handler)
        name = method.removeprefix(_OURS)
        request_id = _request_id(handler_call_details)
        parser: Any = handler.request_deserializer
        if handler.unary_unary is not None:
            unary: Any = handler.unary_unary  # asynchronous, which the stubs do not know

            async def call(raw: bytes, context: Any) -> Any:
                with self._service.bodies.holding() as holding:
                    holding.grow(len(raw))
                    return await unary(parse(method, parser, raw), context)

            async def answer(raw: bytes, context: Any) -> Any:
                return await self._watched(name, request_id, context, call(raw, context), single=True)

            return grpc.unary_unary_rpc_method_handler(answer, None, handler.response_serializer)
        stream: Any = handler.stream_stream

        async def converse(raws: Any, context: Any) -> None:
            requests, settling = parse_all(method, parser, raws), SettlingContext(context)
            await self._watched(name, request_id, settling, stream(requests, settling))

        return grpc.stream_stream_rpc_method_handler(converse, None, handler.response_serializer)

    async def _watched(
        self,
        name: str,
        request_id: str,
        context: Context | SettlingContext,
        work: Awaitable[Any],
        *,
        single: bool = False,
    ) -> Any:
        start = time.perf_counter()

        def count(code: grpc.StatusCode) -> None:  # before the client knows, so that it sees its call counted
            self._service.meter.request("grpc", name, code.name, time.perf_counter() - start)

        try:
            with structlog.contextvars.bound_contextvars(request_id=request_id, method=name):
                result, status = await self._outcome(work, single)
        except asyncio.CancelledError:
            count(grpc.StatusCode.CANCELLED)
            raise
        if status is None:
            count(grpc.StatusCode.OK)
            context.set_trailing_metadata(((_REQUEST_ID, request_id),))
            return result
        count(status.code)
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


def _request_id(details: grpc.HandlerCallDetails) -> str:
    for key, value in details.invocation_metadata or ():
        if key == _REQUEST_ID and isinstance(value, str) and 0 < len(value) <= 128:
            return value
    return secrets.token_hex(8)
