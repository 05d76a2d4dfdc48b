from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from tests.fakes import FakeEstimator, FakeRenderPool, RecordingMeter
from unbend_service.adapters.codecs.pillow import PillowCodec
from unbend_service.adapters.grid_stores.memory import MemoryGridStore
from unbend_service.application.blocking import BlockingWork
from unbend_service.application.correction import Correction
from unbend_service.application.estimation import Estimation
from unbend_service.application.fitting import FittedGrids
from unbend_service.settings import Settings


@dataclass
class Application:
    """Real use cases over fakes of the estimator and the pool."""

    estimation: Estimation
    correction: Correction
    estimator: FakeEstimator
    pool: FakeRenderPool
    meter: RecordingMeter
    store: MemoryGridStore


@asynccontextmanager
async def assembled(min_confidence: float | None) -> AsyncIterator[Application]:
    settings = Settings()
    meter, estimator, pool = RecordingMeter(), FakeEstimator(), FakeRenderPool()
    blocking = BlockingWork(2, settings.queue_frames, meter)
    codec, store = PillowCodec(settings), MemoryGridStore(settings)
    grids = FittedGrids(blocking, meter)
    estimation = Estimation(
        estimator, codec, store, grids, blocking, meter, grid_points=settings.grid_points, min_confidence=min_confidence
    )
    correction = Correction(
        estimation, codec, store, grids, pool, blocking, meter, jpeg_quality=92, deadline_s=settings.render_deadline_s
    )
    yield Application(estimation, correction, estimator, pool, meter, store)
    blocking.close()
    await store.close()


@pytest.fixture
async def application() -> AsyncIterator[Application]:
    """With a threshold of 0.5."""
    async with assembled(0.5) as application:
        yield application


@pytest.fixture
async def advised() -> AsyncIterator[Application]:
    """As careful as the card of the model advises."""
    async with assembled(None) as application:
        yield application


@pytest.fixture
def picture() -> np.ndarray:
    """(96, 128, 3) uint8 BGR, blocks and lines."""
    rng = np.random.default_rng(1)
    blocks = rng.integers(0, 255, (12, 16, 3), dtype=np.uint8)
    return cv2.resize(blocks, (128, 96), interpolation=cv2.INTER_NEAREST)


@pytest.fixture
def jpeg(picture: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", picture)[1].tobytes()
