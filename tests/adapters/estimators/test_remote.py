from __future__ import annotations

from collections.abc import AsyncIterator

import grpc
import numpy as np
import pytest

from tests.assembly import service_over_fakes
from tests.fakes import FAKE_MODEL, FakeEstimator
from unbend_service.adapters.estimators.remote import RemoteEstimator
from unbend_service.application.blocking import BlockingWork
from unbend_service.application.service import Service
from unbend_service.domain.errors import EstimatorUnavailable, QueueFull
from unbend_service.settings import Settings
from unbend_service.transport.rpc.server import start_server

GREY = np.arange(48 * 64, dtype=np.uint8).reshape(48, 64)


@pytest.fixture
async def node() -> AsyncIterator[tuple[Service, grpc.aio.Server, str]]:
    """A node that estimates, over gRPC."""
    settings = Settings(grpc_port=0)
    service = service_over_fakes(settings)
    server, port = await start_server(service, settings)
    yield service, server, f"127.0.0.1:{port}"
    await server.stop(0)
    await service.close(0)


async def test_the_estimate_of_another_node_is_its_estimate(node: tuple[Service, grpc.aio.Server, str]) -> None:
    """Guides, confidence and model come back to the last bit; only the model's name is unknown before."""
    service, _, address = node
    remote = RemoteEstimator(address, 5.0)
    assert remote.model.name == f"remote:{address}"
    blocking = BlockingWork(1, 4, service.meter)
    got = await blocking.run("estimate", remote.estimate, GREY)
    want = FakeEstimator().estimate(GREY)
    assert got.guides.to_dict() == want.guides.to_dict()
    assert (got.confidence, got.confidence_kind, got.expected_error) == (want.confidence, want.confidence_kind, None)
    assert got.model == remote.model == FAKE_MODEL
    assert isinstance(service.estimator, FakeEstimator)
    assert service.estimator.seen == [GREY.shape]
    blocking.close()
    remote.close()


async def test_a_node_that_fails_is_a_typed_error(node: tuple[Service, grpc.aio.Server, str]) -> None:
    """Too busy is told apart from not there; neither takes longer than its time."""
    service, server, address = node
    remote = RemoteEstimator(address, 2.0)
    blocking = BlockingWork(1, 4, service.meter)
    assert isinstance(service.estimator, FakeEstimator)
    service.estimator.failure = QueueFull("Enough.")
    with pytest.raises(QueueFull):
        await blocking.run("estimate", remote.estimate, GREY)
    service.estimator.failure = None
    await server.stop(0)
    with pytest.raises(EstimatorUnavailable, match="estimator_address"):
        await blocking.run("estimate", remote.estimate, GREY)
    blocking.close()
    remote.close()
