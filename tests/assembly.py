"""The whole application over fakes of the estimator and the pool."""

from __future__ import annotations

from tests.fakes import FakeEstimator, FakeRenderPool, RecordingMeter
from unbend_service.adapters.codecs.pillow import PillowCodec
from unbend_service.adapters.drawing.figures import FigureIllustrator
from unbend_service.adapters.exchange.files import ExchangeFiles
from unbend_service.adapters.grid_stores.memory import MemoryGridStore
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
from unbend_service.wiring import build_access


def service_over_fakes(settings: Settings, store: MemoryGridStore | None = None) -> Service:
    """Real use cases, codec and grid store over fakes of the estimator and the pool."""
    meter, estimator, pool = RecordingMeter(), FakeEstimator(), FakeRenderPool()
    access = build_access(settings, meter)
    blocking = BlockingWork(2, settings.queue_frames, meter)
    codec, store = PillowCodec(settings), store or MemoryGridStore(settings)
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
    regions = Regions(pool, settings.local_memory_bytes)
    streams = Streams(estimation, correction, store, codec, blocking, meter, regions, settings)
    library = GridLibrary(store, blocking, grid_points=settings.grid_points)
    return Service(
        estimation=estimation,
        correction=correction,
        illustration=Illustration(estimation, correction, codec, store, FigureIllustrator(), blocking, jpeg_quality=92),
        grids=library,
        exchange=Exchange(ExchangeFiles(), grids, blocking),
        streams=streams,
        regions=regions,
        pool=pool,
        store=store,
        codec=codec,
        meter=meter,
        blocking=blocking,
        estimator=estimator,
        bodies=MemoryBudget(settings.bodies_bytes, "bodies_bytes"),
        access=access,
    )
