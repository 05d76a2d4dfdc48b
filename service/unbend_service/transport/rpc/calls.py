"""Around every call: admission, errors, metrics, request ids."""

from __future__ import annotations

import asyncio
import secrets
import time
from collections.abc import Awaitable, Callable
from typing import Any

import grpc
import structlog

from unbend_service.application.service import Service
from unbend_service.domain.errors import UnbendError
from unbend_service.transport.rpc.status import INTERNAL, Status, status_of

log = structlog.get_logger(__name__)

_OURS = "/unbend.v1."
_REQUEST_ID = "x-request-id"

Context = grpc.aio.ServicerContext[Any, Any]


class CallInterceptor(grpc.aio.ServerInterceptor):  # type: ignore[type-arg] # generic in its stubs only
    """Wraps the methods of unbend.v1; health and reflection are left as they are.

    Servicers raise errors of the application; here they become statuses. A request id is taken from the metadata
    (``x-request-id``) or made, bound to the log lines of the call, and sent back in the trailing metadata.
    """

    def __init__(self, service: Service) -> None:
        self._service = service

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[grpc.RpcMethodHandler[Any, Any]]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> grpc.RpcMethodHandler[Any, Any]:
        handler = await continuation(handler_call_details)
        method = handler_call_details.method
        if handler is None or not method.startswith(_OURS):
            return handler
        name = method.removeprefix(_OURS)
        request_id = _request_id(handler_call_details)
        if handler.unary_unary is not None:
            unary: Any = handler.unary_unary  # asynchronous, which the stubs do not know

            async def answer(request: Any, context: Any) -> Any:
                return await self._watched(name, request_id, context, unary(request, context))

            return grpc.unary_unary_rpc_method_handler(
                answer, handler.request_deserializer, handler.response_serializer
            )
        stream: Any = handler.stream_stream

        async def converse(requests: Any, context: Any) -> None:
            await self._watched(name, request_id, context, stream(requests, context))

        return grpc.stream_stream_rpc_method_handler(
            converse, handler.request_deserializer, handler.response_serializer
        )

    async def _watched(self, name: str, request_id: str, context: Context, work: Awaitable[Any]) -> Any:
        start = time.perf_counter()

        def count(code: grpc.StatusCode) -> None:  # before the client knows, so that it sees its call counted
            self._service.meter.request("grpc", name, code.name, time.perf_counter() - start)

        try:
            with structlog.contextvars.bound_contextvars(request_id=request_id, method=name):
                result, status = await self._outcome(name, work)
        except asyncio.CancelledError:
            count(grpc.StatusCode.CANCELLED)
            raise
        if status is None:
            count(grpc.StatusCode.OK)
            context.set_trailing_metadata(((_REQUEST_ID, request_id),))
            return result
        count(status.code)
        return await context.abort(status.code, status.message, (*status.trailing_metadata, (_REQUEST_ID, request_id)))

    async def _outcome(self, name: str, work: Awaitable[Any]) -> tuple[Any, Status | None]:
        """What a call returned, or the status that it ends with."""
        admitted = False
        try:
            with self._service.admission.admitted():
                admitted = True
                return await work, None
        except UnbendError as error:
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


def _request_id(details: grpc.HandlerCallDetails) -> str:
    for key, value in details.invocation_metadata or ():
        if key == _REQUEST_ID and isinstance(value, str) and 0 < len(value) <= 128:
            return value
    return secrets.token_hex(8)
