"""Traces and logs of a running service, joined by request and trace id."""

from __future__ import annotations

import threading
import time
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import grpc
import pytest
from opentelemetry.proto.collector.trace.v1 import trace_service_pb2 as collector_pb2
from opentelemetry.proto.collector.trace.v1 import trace_service_pb2_grpc as collector_grpc
from opentelemetry.proto.trace.v1.trace_pb2 import Span

import unbend
from tests.acceptance.conftest import Server, start_server, stop_server
from tests.acceptance.test_http import facade

TRACE, PARENT = "4bf92f3577b34da6a3ce929d0e0e4736", "00f067aa0ba902b7"
TRACEPARENT = f"00-{TRACE}-{PARENT}-01"
STAGES = {"queue", "decode", "estimate", "grid", "render", "encode"}


class Collector(collector_grpc.TraceServiceServicer):
    """A collector of OTLP over gRPC that remembers spans."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._spans: list[Span] = []
        self._server = grpc.server(ThreadPoolExecutor(2))
        collector_grpc.add_TraceServiceServicer_to_server(self, self._server)
        self.endpoint = f"http://127.0.0.1:{self._server.add_insecure_port('127.0.0.1:0')}"
        self._server.start()

    def Export(  # noqa: N802 the name of the generated base class
        self, request: collector_pb2.ExportTraceServiceRequest, context: grpc.ServicerContext
    ) -> collector_pb2.ExportTraceServiceResponse:
        found = [span for group in request.resource_spans for scope in group.scope_spans for span in scope.spans]
        with self._lock:
            self._spans += found
        return collector_pb2.ExportTraceServiceResponse()

    def of(self, request_id: str) -> list[Span]:
        with self._lock:
            return [span for span in self._spans if attributes(span).get("unbend.request_id") == request_id]

    def wait_for(self, request_id: str, name: str) -> list[Span]:
        """The spans of a request, once that of the request itself is there."""
        end = time.monotonic() + 20
        while not any(span.name == name for span in self.of(request_id)) and time.monotonic() < end:
            time.sleep(0.1)
        return self.of(request_id)

    def close(self) -> None:
        self._server.stop(0).wait()


def attributes(span: Span) -> dict[str, str]:
    return {each.key: each.value.string_value for each in span.attributes}


@dataclass
class Traced:
    server: Server
    collector: Collector

    def logged(self, request_id: str) -> dict[str, object]:
        end = time.monotonic() + 5
        while time.monotonic() < end:
            for line in list(self.server.lines):
                if line.get("request_id") == request_id and line["event"] == "request":
                    return line
            time.sleep(0.05)
        raise AssertionError(f"nothing was logged of {request_id}")


@pytest.fixture(scope="module")
def traced() -> Iterator[Traced]:
    collector = Collector()
    server = start_server(workers="1", renderer="cpu", otlp_endpoint=collector.endpoint)
    yield Traced(server, collector)
    assert stop_server(server) == 0
    collector.close()


def test_a_request_is_a_span_of_the_callers_trace_with_one_for_each_stage(traced: Traced, jpeg: bytes) -> None:
    request = urllib.request.Request(
        f"http://{traced.server.http}/v1/correct?min_confidence=0",
        data=jpeg,
        headers={"traceparent": TRACEPARENT, "X-Request-Id": "over-http"},
    )
    with urllib.request.urlopen(request, timeout=60) as answer:
        assert answer.status == 200
    spans = traced.collector.wait_for("over-http", "POST /v1/correct")
    (whole,) = [span for span in spans if span.name == "POST /v1/correct"]
    assert (whole.trace_id.hex(), whole.parent_span_id.hex()) == (TRACE, PARENT)
    stages = [span for span in spans if span is not whole]
    assert {span.name for span in stages} == STAGES
    for span in stages:
        assert (span.trace_id, span.parent_span_id) == (whole.trace_id, whole.span_id)
        assert span.start_time_unix_nano <= span.end_time_unix_nano <= whole.end_time_unix_nano
    line = traced.logged("over-http")
    assert (line["trace_id"], line["status"]) == (TRACE, 200)


def test_a_stream_over_grpc_has_the_stages_of_its_frames(traced: Traced) -> None:
    metadata = (("traceparent", TRACEPARENT), ("x-request-id", "over-grpc"))
    picture = facade(320, 240)
    client = unbend.Client(traced.server.grpc, metadata=metadata)
    with client, client.stream(320, 240, "rgb24", frames=1, min_confidence=0.0) as stream:
        assert len(list(stream.correct([picture] * 3))) == 3
    spans = traced.collector.wait_for("over-grpc", "CorrectionService/CorrectStream")
    (whole,) = [span for span in spans if span.name == "CorrectionService/CorrectStream"]
    assert (whole.trace_id.hex(), whole.parent_span_id.hex()) == (TRACE, PARENT)
    assert {"queue", "estimate", "render"} <= {span.name for span in spans}
    line = traced.logged("over-grpc")
    assert (line["trace_id"], line["code"]) == (TRACE, "OK")


def test_a_request_without_a_trace_begins_one_that_its_log_line_names(traced: Traced, jpeg: bytes) -> None:
    request = urllib.request.Request(
        f"http://{traced.server.http}/v1/estimate",
        data=jpeg,
        headers={"traceparent": "00-broken", "X-Request-Id": "alone"},
    )
    with urllib.request.urlopen(request, timeout=60):
        pass
    spans = traced.collector.wait_for("alone", "POST /v1/estimate")
    (whole,) = [span for span in spans if span.name == "POST /v1/estimate"]
    assert whole.parent_span_id == b""
    assert traced.logged("alone")["trace_id"] == whole.trace_id.hex() != TRACE


def test_a_collector_that_is_gone_harms_nobody(jpeg: bytes) -> None:
    """Requests are answered, and the service stops in time."""
    server = start_server(workers="1", renderer="cpu", otlp_endpoint="http://127.0.0.1:9")
    try:
        request = urllib.request.Request(f"http://{server.http}/v1/estimate", data=jpeg)
        with urllib.request.urlopen(request, timeout=60) as answer:
            assert answer.status == 200
    finally:
        assert stop_server(server) == 0
