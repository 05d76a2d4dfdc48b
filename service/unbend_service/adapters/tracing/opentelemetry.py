"""Spans to an OpenTelemetry collector: one a request, and one for each stage of the work on it."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from importlib.metadata import version

from opentelemetry.exporter.otlp.proto.grpc.trace_exporter import OTLPSpanExporter
from opentelemetry.sdk.resources import Resource
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import BatchSpanProcessor, SpanExporter
from opentelemetry.sdk.trace.sampling import ParentBased, TraceIdRatioBased
from opentelemetry.trace import Span, SpanKind, Status, StatusCode, format_trace_id, set_span_in_context
from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

from unbend_service.adapters.metrics.prometheus import PrometheusMeter

#: A stream may last for days: its later frames have no spans.
_STAGES_AT_MOST = 256
_EXPORT_S = 3.0


@dataclass(slots=True)
class RequestSpan:
    """Of a request under way."""

    span: Span
    request_id: str
    trace_id: str
    stages: int = 0

    def answered(self, name: str, code: str, failed: bool) -> None:
        """Says what the request was and how it ended."""
        self.span.update_name(name)
        self.span.set_attribute("unbend.code", code)
        if self.stages > _STAGES_AT_MOST:
            self.span.set_attribute("unbend.stages_left_out", self.stages - _STAGES_AT_MOST)
        if failed:
            self.span.set_status(Status(StatusCode.ERROR))


_CURRENT: ContextVar[RequestSpan | None] = ContextVar("request_span", default=None)


class OpenTelemetryTracer:
    """Port Tracer. It is not the tracer of the process: other libraries' spans stay out of it.

    Args:
        endpoint: of a collector, OTLP over gRPC, ``http://host:4317``.
        share: 0..1 of the traces that begin here; those that a caller began are as he decided.
        exporter: used instead of one to ``endpoint``.
    """

    def __init__(self, endpoint: str, share: float, exporter: SpanExporter | None = None) -> None:
        resource = Resource.create({"service.name": "unbend", "service.version": version("unbend")})
        self._provider = TracerProvider(
            resource=resource, sampler=ParentBased(TraceIdRatioBased(share)), shutdown_on_exit=False
        )
        exporter = exporter or OTLPSpanExporter(endpoint=endpoint, timeout=_EXPORT_S)
        self._provider.add_span_processor(BatchSpanProcessor(exporter))
        self._tracer = self._provider.get_tracer("unbend")
        self._propagator = TraceContextTextMapPropagator()

    @contextmanager
    def request(self, transport: str, name: str, request_id: str, traceparent: str | None) -> Iterator[RequestSpan]:
        """The span of one request, the child of the caller's."""
        parent = self._propagator.extract({"traceparent": traceparent or ""})
        attributes = {"unbend.request_id": request_id, "unbend.transport": transport}
        span = self._tracer.start_span(name, parent, SpanKind.SERVER, attributes)
        request = RequestSpan(span, request_id, format_trace_id(span.get_span_context().trace_id))
        before = _CURRENT.set(request)
        try:
            yield request
        finally:
            _CURRENT.reset(before)
            span.end()

    def stage(self, stage: str, seconds: float) -> None:
        """A stage that ended just now, of the request in whose context this is called."""
        request = _CURRENT.get()
        if request is None:
            return
        request.stages += 1
        if request.stages > _STAGES_AT_MOST:
            return
        end_ns = time.time_ns()
        span = self._tracer.start_span(
            stage,
            set_span_in_context(request.span),
            attributes={"unbend.request_id": request.request_id},
            start_time=end_ns - round(seconds * 1e9),
        )
        span.end(end_ns)

    async def close(self) -> None:
        """Sends what waits, a few seconds at most."""
        await asyncio.to_thread(self._provider.force_flush, round(_EXPORT_S * 1000))
        await asyncio.to_thread(self._provider.shutdown)


class TracingMeter(PrometheusMeter):
    """Counts stages, and makes spans of them."""

    def __init__(self, tracer: OpenTelemetryTracer) -> None:
        super().__init__()
        self._tracer = tracer

    def stage(self, stage: str, seconds: float) -> None:
        super().stage(stage, seconds)
        self._tracer.stage(stage, seconds)
