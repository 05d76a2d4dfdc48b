from __future__ import annotations

import io
from collections.abc import AsyncIterator
from dataclasses import dataclass, field

import httpx
import numpy as np
import pytest
from PIL import Image

from tests.fakes import FakeEstimator, FakeRenderPool
from unbend_service.adapters.codecs.pillow import PillowCodec
from unbend_service.adapters.drawing.figures import FigureIllustrator
from unbend_service.adapters.exchange.files import ExchangeFiles
from unbend_service.adapters.grid_stores.memory import MemoryGridStore
from unbend_service.adapters.metrics.prometheus import PrometheusMeter
from unbend_service.application.blocking import BlockingWork
from unbend_service.application.budget import MemoryBudget
from unbend_service.application.correction import Correction
from unbend_service.application.estimation import Estimation
from unbend_service.application.exchange import Exchange
from unbend_service.application.fitting import FittedGrids
from unbend_service.application.grids import GridLibrary
from unbend_service.application.illustration import Illustration
from unbend_service.application.regions import Regions
from unbend_service.application.service import Service
from unbend_service.application.streams import Streams
from unbend_service.settings import Settings
from unbend_service.transport.rest.app import create_app
from unbend_service.wiring import build_access


@dataclass
class Bench:
    """The HTTP application over real use cases, codec, store and meter; only estimator and renderer are fakes."""

    settings: Settings
    estimator: FakeEstimator = field(default_factory=FakeEstimator)
    pool: FakeRenderPool = field(default_factory=FakeRenderPool)
    meter: PrometheusMeter = field(default_factory=PrometheusMeter)

    def __post_init__(self) -> None:
        settings, meter = self.settings, self.meter
        self.blocking = blocking = BlockingWork(2, settings.queue_frames, meter)
        codec, store = PillowCodec(settings), MemoryGridStore(settings)
        fitted = FittedGrids(blocking, meter)
        estimation = Estimation(
            self.estimator,
            codec,
            store,
            fitted,
            blocking,
            meter,
            grid_points=settings.grid_points,
            min_confidence=settings.min_confidence,
        )
        correction = Correction(
            estimation,
            codec,
            store,
            fitted,
            self.pool,
            blocking,
            meter,
            jpeg_quality=settings.jpeg_quality,
            deadline_s=settings.render_deadline_s,
        )
        illustration = Illustration(
            estimation, correction, codec, store, FigureIllustrator(), blocking, jpeg_quality=90
        )
        regions = Regions(self.pool, settings.local_memory_bytes)
        self.service = Service(
            estimation=estimation,
            correction=correction,
            illustration=illustration,
            grids=GridLibrary(store, blocking, grid_points=settings.grid_points),
            exchange=Exchange(ExchangeFiles(), fitted, blocking),
            streams=Streams(estimation, correction, store, codec, blocking, meter, regions, settings),
            regions=regions,
            pool=self.pool,
            store=store,
            codec=codec,
            meter=meter,
            blocking=blocking,
            estimator=self.estimator,
            bodies=MemoryBudget(settings.bodies_bytes, "bodies_bytes"),
            access=build_access(settings, meter),
        )
        self.app = create_app(self.service, settings)
        self.client = httpx.AsyncClient(transport=httpx.ASGITransport(self.app), base_url="http://unbend")

    async def close(self) -> None:
        await self.client.aclose()
        await self.service.close(0.0)


@pytest.fixture
async def bench() -> AsyncIterator[Bench]:
    built = Bench(Settings(grid_points=17, body_bytes=300_000, source_pixels=1_000_000))
    await built.service.start()
    yield built
    await built.close()


@pytest.fixture
def client(bench: Bench) -> httpx.AsyncClient:
    return bench.client


def chequers(width: int = 160, height: int = 120) -> Image.Image:
    """Coloured squares: straight lines everywhere."""
    y, x = np.mgrid[0:height, 0:width]
    odd = (x // 16 + y // 16) % 2
    colours = np.stack([odd * 255, np.full_like(odd, 120), x * 255 // width], -1)
    return Image.fromarray(colours.astype(np.uint8))


def encoded(image: Image.Image, image_format: str, **options: object) -> bytes:
    out = io.BytesIO()
    image.save(out, image_format, **options)
    return out.getvalue()


@pytest.fixture
def jpeg() -> bytes:
    return encoded(chequers(), "jpeg", quality=90)
