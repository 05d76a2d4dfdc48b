"""Counts for Prometheus: base units (seconds), names under ``unbend_``, a registry of its own."""

from __future__ import annotations

import sys
from collections import Counter as Tally
from collections.abc import Iterable

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, Info
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest
from prometheus_client.metrics_core import Metric

from unbend_service.allocator import Heap, heap
from unbend_service.application.ports import ModelInfo, PoolState

STAGES = ("queue", "decode", "estimate", "grid", "render", "encode")
FRAME_RESULTS = ("corrected", "left_alone", "passed_through", "dropped", "failed")
ESTIMATE_OUTCOMES = ("corrected", "left_alone")
WORKER_STATES = ("starting", "ready", "busy", "dead")
GRID_STORE_OPERATIONS = ("put", "get", "delete", "bind", "stream", "claim")

# A frame takes a few ms on a GPU; a large picture some seconds on two cores.
_STAGE_BUCKETS_S = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
_REQUEST_BUCKETS_S = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0, 60.0)


class PrometheusMeter:
    """Port Meter. Thread-safe; two meters of one process do not know each other."""

    def __init__(self) -> None:
        registry = CollectorRegistry()
        self._registry = registry
        self._requests = Counter(
            "unbend_requests",
            "Calls answered, by transport, method and status code.",
            ["transport", "method", "code"],
            registry=registry,
        )
        self._request_duration = Histogram(
            "unbend_request_duration_seconds",
            "From the first byte of a call to the last byte of its answer.",
            ["transport", "method"],
            buckets=_REQUEST_BUCKETS_S,
            registry=registry,
        )
        self._stages = Histogram(
            "unbend_stage_duration_seconds",
            "Time spent in one stage of the work on a picture or frame.",
            ["stage"],
            buckets=_STAGE_BUCKETS_S,
            registry=registry,
        )
        self._frames = Counter(
            "unbend_frames", "Pictures and frames, by what came of them.", ["result"], registry=registry
        )
        self._estimates = Counter("unbend_estimates", "Decisions on estimates.", ["outcome"], registry=registry)
        self._streams = Gauge("unbend_streams_active", "Streams that are open.", registry=registry)
        self._queue = Gauge("unbend_queue_depth", "Frames that wait for a render worker.", registry=registry)
        self._rejections = Counter("unbend_rejections", "Work refused at a limit.", ["reason"], registry=registry)
        self._workers = Gauge("unbend_workers", "Render workers by state.", ["state"], registry=registry)
        self._restarts = Counter(
            "unbend_worker_restarts", "Render workers that had to be replaced.", ["reason"], registry=registry
        )
        self._cache = Counter(
            "unbend_grid_cache_requests", "Look-ups of fitted grids: hit or miss.", ["result"], registry=registry
        )
        self._store = Counter(
            "unbend_grid_store_operations",
            "Calls of the shared grid store: answered by it (shared), by the replica itself (local), or unreadable.",
            ["operation", "result"],
            registry=registry,
        )
        self._store_up = Gauge(
            "unbend_grid_store_up", "0 while the shared grid store does not answer, else 1.", registry=registry
        )
        self._store_outages = Counter(
            "unbend_grid_store_outages", "Times that the shared grid store stopped answering.", registry=registry
        )
        memory = Gauge(
            "unbend_memory_bytes",
            "What malloc of the parent process has handed out (used), and keeps for the next who asks (free).",
            ["state"],
            registry=registry,
        )
        blocks = Gauge(
            "unbend_python_blocks",
            "Blocks that Python has handed out in the parent process.",
            registry=registry,
        )
        memory.labels("used").set_function(lambda: _heap().used_bytes)
        memory.labels("free").set_function(lambda: _heap().free_bytes)
        blocks.set_function(sys.getallocatedblocks)
        self._renderer = Info("unbend_renderer", "Which renderer the workers run.", registry=registry)
        self._model = Info("unbend_model", "Which network estimates.", registry=registry)
        for stage in STAGES:
            self._stages.labels(stage)
        for result in FRAME_RESULTS:
            self._frames.labels(result)
        for outcome in ESTIMATE_OUTCOMES:
            self._estimates.labels(outcome)
        for result in ("hit", "miss"):
            self._cache.labels(result)
        for state in WORKER_STATES:
            self._workers.labels(state)
        for operation in GRID_STORE_OPERATIONS:
            for result in ("shared", "local"):
                self._store.labels(operation, result)
        self._store_up.set(1)

    def request(self, transport: str, method: str, code: str, seconds: float) -> None:
        self._requests.labels(transport, method, code).inc()
        self._request_duration.labels(transport, method).observe(seconds)

    def stage(self, stage: str, seconds: float) -> None:
        self._stages.labels(stage).observe(seconds)

    def frame(self, result: str) -> None:
        self._frames.labels(result).inc()

    def estimate(self, outcome: str) -> None:
        self._estimates.labels(outcome).inc()

    def stream_opened(self) -> None:
        self._streams.inc()

    def stream_closed(self) -> None:
        self._streams.dec()

    def rejected(self, reason: str) -> None:
        self._rejections.labels(reason).inc()

    def worker_restarted(self, reason: str) -> None:
        self._restarts.labels(reason).inc()

    def grid_cache(self, hit: bool) -> None:
        self._cache.labels("hit" if hit else "miss").inc()

    def grid_store(self, operation: str, result: str) -> None:
        self._store.labels(operation, result).inc()

    def grid_store_up(self, up: bool) -> None:
        self._store_up.set(up)
        if not up:
            self._store_outages.inc()

    def pool(self, state: PoolState) -> None:
        self._queue.set(state.queued)
        tally = Tally(worker.state for worker in state.workers)
        for name in {*WORKER_STATES, *tally}:
            self._workers.labels(name).set(tally[name])
        if state.renderer is not None:
            hardware = "true" if state.renderer.hardware else "false"
            self._renderer.info({"name": state.renderer.name, "device": state.renderer.device, "hardware": hardware})

    def model(self, model: ModelInfo) -> None:
        self._model.info({"name": model.name, "sha256": model.sha256})

    def render(self) -> tuple[bytes, str]:
        """Everything counted so far, in the Prometheus text format, and its content type."""
        return generate_latest(_WithoutBirthdays(self._registry)), CONTENT_TYPE_LATEST


def _heap() -> Heap:
    return heap() or Heap(0, 0)


class _WithoutBirthdays(CollectorRegistry):
    """A view of a registry without the ``_created`` samples, which would double every scrape for nobody's use.

    The library can leave them out too, but only for all of the process.
    """

    def __init__(self, registry: CollectorRegistry) -> None:
        super().__init__()
        self._behind = registry

    def collect(self) -> Iterable[Metric]:
        for family in self._behind.collect():
            family.samples = [sample for sample in family.samples if not sample.name.endswith("_created")]
            yield family
