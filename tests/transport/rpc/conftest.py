from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import dataclass

import grpc
import pytest

from tests.fakes import FAKE_MODEL, FakeEstimator, FakeRenderPool, RecordingMeter
from unbend.v1 import correction_pb2_grpc, estimation_pb2_grpc, grid_pb2_grpc
from unbend_service.adapters.codecs.pillow import PillowCodec
from unbend_service.adapters.drawing.overlay import OverlayIllustrator
from unbend_service.adapters.grid_stores.memory import MemoryGridStore
from unbend_service.application.blocking import BlockingWork
from unbend_service.application.correction import Correction
from unbend_service.application.estimation import Estimation
from unbend_service.application.fitting import FittedGrids
from unbend_service.application.grids import GridLibrary
from unbend_service.application.illustration import Illustration
from unbend_service.application.service import Service
from unbend_service.application.streams import Streams
from unbend_service.settings import Settings
from unbend_service.transport.rpc.server import start_server


def service_over_fakes(settings: Settings) -> Service:
    """Real use cases, codec and grid store over fakes of the estimator and the pool."""
    meter, estimator, pool = RecordingMeter(), FakeEstimator(), FakeRenderPool()
    blocking = BlockingWork(2, settings.queue_frames, meter)
    codec, store = PillowCodec(settings), MemoryGridStore(settings)
    grids = FittedGrids(blocking, meter)
    estimation = Estimation(
        estimator,
        codec,
        store,
        grids,
        blocking,
        meter,
        grid_points=settings.grid_points,
        min_confidence=settings.min_confidence,
    )
    correction = Correction(
        estimation, codec, store, grids, pool, blocking, meter, jpeg_quality=92, deadline_s=settings.render_deadline_s
    )
    streams = Streams(estimation, correction, store, codec, blocking, meter, settings)
    library = GridLibrary(store, grid_points=settings.grid_points)
    return Service(
        estimation=estimation,
        correction=correction,
        illustration=Illustration(estimation, codec, store, OverlayIllustrator(), blocking, jpeg_quality=92),
        grids=library,
        streams=streams,
        pool=pool,
        store=store,
        codec=codec,
        meter=meter,
        blocking=blocking,
        model=FAKE_MODEL,
    )


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
