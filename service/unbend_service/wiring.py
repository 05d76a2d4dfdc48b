"""The one module that names concrete adapters and plugs them into the use cases."""

from __future__ import annotations

from collections.abc import Callable

from unbend_service.adapters.codecs.pillow import PillowCodec
from unbend_service.adapters.cores import usable_cores
from unbend_service.adapters.decoding.codec import IsolatedCodec
from unbend_service.adapters.decoding.files import IsolatedFiles
from unbend_service.adapters.decoding.pool import DecoderPool
from unbend_service.adapters.drawing.figures import FigureIllustrator
from unbend_service.adapters.estimators.catalogue import load_estimator
from unbend_service.adapters.estimators.node_credentials import read_node_credentials
from unbend_service.adapters.estimators.remote import RemoteEstimator
from unbend_service.adapters.exchange.files import ExchangeFiles
from unbend_service.adapters.grid_stores.memory import MemoryGridStore
from unbend_service.adapters.grid_stores.sheltered import ShelteredGridStore
from unbend_service.adapters.grid_stores.sqlite import SqliteGridStore
from unbend_service.adapters.metrics.prometheus import PrometheusMeter
from unbend_service.adapters.renderers.absent import AbsentPool
from unbend_service.adapters.renderers.pool import WorkerPool
from unbend_service.adapters.tokens.file import TokenFile
from unbend_service.application.access import Access
from unbend_service.application.admission import Admission
from unbend_service.application.blocking import BlockingWork
from unbend_service.application.budget import MemoryBudget
from unbend_service.application.correction import Correction
from unbend_service.application.estimation import Estimation
from unbend_service.application.exchange import Exchange
from unbend_service.application.fitting import FittedGrids
from unbend_service.application.grids import GridLibrary
from unbend_service.application.illustration import Illustration
from unbend_service.application.ports import Estimator, GridStore, Meter, RenderPool, Tracer
from unbend_service.application.regions import Regions
from unbend_service.application.service import Service
from unbend_service.application.streams import Streams
from unbend_service.application.tracing import NoTracer
from unbend_service.domain.errors import InvalidOption
from unbend_service.settings import Settings

#: Estimates of another node that are waited for at once: threads that sleep.
REMOTE_ESTIMATES = 32


def build_store(settings: Settings, meter: Meter | None = None) -> GridStore:
    """The grid store that the settings name.

    Raises:
        InvalidOption, GridStoreUnavailable: it cannot be had.
    """
    if settings.grid_store == "sqlite":
        return SqliteGridStore(settings)
    if settings.grid_store == "redis":
        # a sixth of the time that a start takes, and most replicas need none
        from unbend_service.adapters.grid_stores.redis import RedisGridStore

        meter = meter or PrometheusMeter()
        kept = settings.grid_store_local_entries
        return ShelteredGridStore(
            RedisGridStore(settings, meter),
            MemoryGridStore(settings, entries=kept),
            meter,
            retry_s=settings.redis_retry_s,
            owed_entries=kept,
        )
    return MemoryGridStore(settings)


def build_pool(settings: Settings, meter: Meter) -> RenderPool:
    """The render workers, or none on a node that only estimates."""
    return AbsentPool() if settings.role == "estimate" else WorkerPool(settings, meter)


def build_remote_estimator(settings: Settings) -> RemoteEstimator:
    """The estimator of a node that only renders. Raises InvalidOption if nothing says where the other node is."""
    if settings.estimator_address is None:
        raise InvalidOption(
            "A node that only renders has to know who estimates.",
            allowed="host:port of a node with the role all or estimate",
            setting="estimator_address",
        )
    credentials = read_node_credentials(settings)
    return RemoteEstimator(
        settings.estimator_address,
        settings.estimator_timeout_s,
        credentials=credentials.channel,
        metadata=credentials.metadata,
    )


def build_meter(settings: Settings) -> tuple[Meter, Tracer]:
    """What counts, and what makes spans. Raises InvalidOption: traces are wanted and the extra is not installed."""
    if settings.otlp_endpoint is None:
        return PrometheusMeter(), NoTracer()
    try:
        from unbend_service.adapters.tracing.opentelemetry import OpenTelemetryTracer, TracingMeter
    except ImportError as error:
        raise InvalidOption(
            f"Traces need the extra otel ({error.name} is missing).",
            allowed="pip install 'unbend[otel]'",
            setting="otlp_endpoint",
        ) from error
    tracer = OpenTelemetryTracer(settings.otlp_endpoint, settings.trace_share)
    return TracingMeter(tracer), tracer


def build_access(settings: Settings, meter: Meter) -> Access:
    """Who is let in. Raises InvalidOption: the tokens cannot be read."""
    return Access(
        TokenFile(settings.tokens_file) if settings.tokens_file is not None else None,
        meter,
        rate_per_s=settings.token_rate_per_s,
        burst=settings.token_burst,
        streams=settings.token_streams,
    )


def build_exchange() -> Exchange:
    """Grids to and from files alone, for commands: no model is loaded and no worker started."""
    meter = PrometheusMeter()
    blocking = BlockingWork(1, 8, meter)
    return Exchange(ExchangeFiles(), FittedGrids(blocking, meter), blocking)


def build_service(settings: Settings) -> Service:
    """The whole application, not yet started.

    Raises:
        InvalidOption: the model is not known or its file is broken; the tokens cannot be read;
            traces are wanted and the extra is not installed.
    """
    meter, tracer = build_meter(settings)
    access = build_access(settings, meter)
    cores = usable_cores()
    blocking = BlockingWork(cores, settings.queue_frames, meter, waiting=settings.decoders or cores)
    decoders = DecoderPool(settings, meter)
    codec = IsolatedCodec(decoders, PillowCodec(settings))
    store = build_store(settings, meter)
    fitted_grids = FittedGrids(blocking, meter)
    pool = build_pool(settings, meter)
    estimator: Estimator
    elsewhere: BlockingWork | None = None
    closing: tuple[Callable[[], None], ...] = ()
    if settings.role == "render":
        remote = build_remote_estimator(settings)
        elsewhere = BlockingWork(REMOTE_ESTIMATES, settings.queue_frames, meter)
        estimator, closing = remote, (elsewhere.close, remote.close)
    else:
        estimator = load_estimator(settings.model, settings.estimator_threads or cores)
    estimation = Estimation(
        estimator,
        codec,
        store,
        fitted_grids,
        blocking,
        meter,
        grid_points=settings.grid_points,
        min_confidence=settings.min_confidence,
        known_images=settings.known_images,
        elsewhere=elsewhere,
    )
    correction = Correction(
        estimation,
        codec,
        store,
        fitted_grids,
        pool,
        blocking,
        meter,
        jpeg_quality=settings.jpeg_quality,
        deadline_s=settings.render_deadline_s,
        offered=settings.role != "estimate",
    )
    illustration = Illustration(
        estimation, correction, codec, store, FigureIllustrator(), blocking, jpeg_quality=settings.jpeg_quality
    )
    grids = GridLibrary(store, blocking, grid_points=settings.grid_points)
    exchange = Exchange(IsolatedFiles(decoders), fitted_grids, blocking)
    regions = Regions(pool, settings.local_memory_bytes)
    streams = Streams(estimation, correction, store, codec, blocking, meter, regions, settings)
    return Service(
        estimation,
        correction,
        illustration,
        grids,
        exchange,
        streams,
        regions,
        pool,
        store,
        codec,
        meter,
        blocking,
        estimator,
        MemoryBudget(settings.bodies_bytes, "bodies_bytes"),
        access,
        admission=Admission(settings.queue_frames - settings.queue_frames // 2),
        role=settings.role,
        tracer=tracer,
        closing=closing,
    )
