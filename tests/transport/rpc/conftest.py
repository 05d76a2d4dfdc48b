from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import dataclass

import grpc
import pytest

from tests.assembly import service_over_fakes
from tests.fakes import FakeRenderPool, RecordingMeter
from unbend.v1 import correction_pb2_grpc, estimation_pb2_grpc, grid_pb2_grpc
from unbend_service.application.service import Service
from unbend_service.settings import Settings
from unbend_service.transport.rpc.server import start_server


@dataclass
class Rpc:
    """A server on a free port, a channel to it, and what stands behind it."""

    service: Service
    server: grpc.aio.Server
    channel: grpc.aio.Channel

    @property
    def correction(self) -> correction_pb2_grpc.CorrectionServiceAsyncStub:
        return correction_pb2_grpc.CorrectionServiceStub(self.channel)

    @property
    def estimation(self) -> estimation_pb2_grpc.EstimationServiceAsyncStub:
        return estimation_pb2_grpc.EstimationServiceStub(self.channel)

    @property
    def grids(self) -> grid_pb2_grpc.GridServiceAsyncStub:
        return grid_pb2_grpc.GridServiceStub(self.channel)

    @property
    def meter(self) -> RecordingMeter:
        assert isinstance(self.service.meter, RecordingMeter)
        return self.service.meter

    @property
    def pool(self) -> FakeRenderPool:
        assert isinstance(self.service.pool, FakeRenderPool)
        return self.service.pool


@pytest.fixture
async def rpc() -> AsyncIterator[Rpc]:
    settings = Settings(grpc_port=0, grid_points=17, body_bytes=1 << 20, stream_estimate_wait_s=0.2)
    service = service_over_fakes(settings)
    server, port = await start_server(service, settings)
    async with grpc.aio.insecure_channel(f"127.0.0.1:{port}") as channel:
        yield Rpc(service, server, channel)
    await server.stop(0)
    await service.close(0)
