"""``grpc.health.v1.Health``: serving as long as calls sent now would be answered.

``live`` serves for as long as the process answers at all: a probe that restarts what fails it must not restart a
service that drains, or that waits for a renderer.
"""

from __future__ import annotations

import asyncio

import grpc
from grpc_health.v1 import health_pb2, health_pb2_grpc

from unbend_service.application.service import Service
from unbend_service.transport.rpc.calls import Context

_LOOK_EVERY_S = 0.5
LIVE = "live"


class HealthServicer(health_pb2_grpc.HealthServicer):  # type: ignore[misc] # grpc_health has no types
    """Looks at the readiness of the service whenever it is asked, so that no state can grow old.

    Args:
        names: the services that may be asked for, beside "" for all of them and ``live``.
    """

    def __init__(self, service: Service, names: tuple[str, ...]) -> None:
        self._service = service
        self._names = ("", LIVE, *names)

    async def Check(  # noqa: N802 the name of the generated base class
        self, request: health_pb2.HealthCheckRequest, context: Context
    ) -> health_pb2.HealthCheckResponse:
        if request.service not in self._names:
            await context.abort(grpc.StatusCode.NOT_FOUND, f"There is no service {request.service!r}.")
        return health_pb2.HealthCheckResponse(status=self._status(request.service))

    async def List(  # noqa: N802 as above
        self, request: health_pb2.HealthListRequest, context: Context
    ) -> health_pb2.HealthListResponse:
        statuses = {name: health_pb2.HealthCheckResponse(status=self._status(name)) for name in self._names}
        return health_pb2.HealthListResponse(statuses=statuses)

    async def Watch(  # noqa: N802 as above
        self, request: health_pb2.HealthCheckRequest, context: Context
    ) -> None:
        told = None
        while True:
            status = self._status(request.service)
            if status != told:
                told = status
                await context.write(health_pb2.HealthCheckResponse(status=status))
            await asyncio.sleep(_LOOK_EVERY_S)

    def _status(self, name: str) -> int:
        if name not in self._names:
            return int(health_pb2.HealthCheckResponse.SERVICE_UNKNOWN)
        ready = name == LIVE or self._service.readiness().ready
        return int(health_pb2.HealthCheckResponse.SERVING if ready else health_pb2.HealthCheckResponse.NOT_SERVING)
