from __future__ import annotations

from prometheus_client.parser import text_string_to_metric_families

from unbend_service.adapters.metrics.prometheus import PrometheusMeter
from unbend_service.application.ports import ModelInfo, PoolState, RendererInfo, WorkerState


def samples(meter: PrometheusMeter) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    body, content_type = meter.render()
    assert content_type.startswith("text/plain")
    families = text_string_to_metric_families(body.decode())
    return {(s.name, tuple(sorted(s.labels.items()))): s.value for family in families for s in family.samples}


def value(meter: PrometheusMeter, metric: str, /, **labels: str) -> float | None:
    return samples(meter).get((metric, tuple(sorted(labels.items()))))


def test_requests_are_counted_and_timed() -> None:
    """A call shows up once, under its transport, method and code, and its duration in seconds."""
    meter = PrometheusMeter()
    meter.request("http", "POST /v1/correct", "200", 0.25)
    meter.request("http", "POST /v1/correct", "422", 0.5)
    labels = {"transport": "http", "method": "POST /v1/correct"}
    assert value(meter, "unbend_requests_total", **labels, code="200") == 1
    assert value(meter, "unbend_requests_total", **labels, code="422") == 1
    assert value(meter, "unbend_request_duration_seconds_count", **labels) == 2
    assert value(meter, "unbend_request_duration_seconds_sum", **labels) == 0.75


def test_every_stage_is_there_from_the_start() -> None:
    """A dashboard finds each stage before the first picture came."""
    meter = PrometheusMeter()
    for stage in ("queue", "decode", "estimate", "grid", "render", "encode"):
        assert value(meter, "unbend_stage_duration_seconds_count", stage=stage) == 0
    meter.stage("decode", 0.003)
    assert value(meter, "unbend_stage_duration_seconds_sum", stage="decode") == 0.003
    assert value(meter, "unbend_stage_duration_seconds_bucket", stage="decode", le="0.005") == 1
    assert value(meter, "unbend_stage_duration_seconds_bucket", stage="decode", le="0.002") == 0


def test_what_happens_to_frames_and_streams_is_counted() -> None:
    """Frames by result, estimates by outcome, streams that are open, refusals, restarts, cache."""
    meter = PrometheusMeter()
    meter.frame("corrected")
    meter.estimate("left_alone")
    meter.stream_opened()
    meter.stream_opened()
    meter.stream_closed()
    meter.rejected("queue_full")
    meter.worker_restarted("exited")
    meter.grid_cache(True)
    meter.grid_cache(False)
    meter.grid_cache(False)
    assert value(meter, "unbend_frames_total", result="corrected") == 1
    assert value(meter, "unbend_frames_total", result="failed") == 0
    assert value(meter, "unbend_estimates_total", outcome="left_alone") == 1
    assert value(meter, "unbend_streams_active") == 1
    assert value(meter, "unbend_rejections_total", reason="queue_full") == 1
    assert value(meter, "unbend_worker_restarts_total", reason="exited") == 1
    assert value(meter, "unbend_grid_cache_requests_total", result="hit") == 1
    assert value(meter, "unbend_grid_cache_requests_total", result="miss") == 2


def test_the_pool_is_shown_as_it_is_now() -> None:
    """Workers move between states without leaving a trace in the old one; renderer and model are named."""
    meter = PrometheusMeter()
    renderer = RendererInfo("egl", "llvmpipe (LLVM 19)", hardware=False)
    meter.pool(PoolState(True, "", renderer, 3, [WorkerState("0", "ready"), WorkerState("1", "busy")]))
    meter.pool(PoolState(True, "", renderer, 1, [WorkerState("0", "ready"), WorkerState("1", "ready")]))
    meter.model(ModelInfo("first", "ab" * 32))
    assert value(meter, "unbend_workers", state="ready") == 2
    assert value(meter, "unbend_workers", state="busy") == 0
    assert value(meter, "unbend_queue_depth") == 1
    device = {"name": "egl", "device": "llvmpipe (LLVM 19)", "hardware": "false"}
    assert value(meter, "unbend_renderer_info", **device) == 1
    assert value(meter, "unbend_model_info", name="first", sha256="ab" * 32) == 1


def test_meters_are_independent() -> None:
    """Two services in one process do not count each other's work, and nothing is registered globally."""
    one, other = PrometheusMeter(), PrometheusMeter()
    one.frame("corrected")
    assert value(other, "unbend_frames_total", result="corrected") == 0


def test_every_name_is_prefixed() -> None:
    """Whoever scrapes finds all of it under unbend_."""
    assert all(name.startswith("unbend_") for name, _ in samples(PrometheusMeter()))


def test_memory_in_use_is_told_from_memory_that_is_kept() -> None:
    """A leak shows as what is in use; what only the allocator keeps does not."""
    meter = PrometheusMeter()
    before = value(meter, "unbend_memory_bytes", state="used")
    held = bytearray(64 << 20)
    after = value(meter, "unbend_memory_bytes", state="used")
    assert before is not None
    assert after is not None
    assert after - before > 0.9 * len(held)
    assert (value(meter, "unbend_memory_bytes", state="free") or 0) > 0
    assert (value(meter, "unbend_python_blocks") or 0) > 10_000


def test_nothing_is_said_twice() -> None:
    """Creation times, which double a scrape, are left out."""
    meter = PrometheusMeter()
    meter.frame("corrected")
    assert not [name for name, _ in samples(meter) if name.endswith("_created")]
