"""Requests without spans: where no tracer is set up."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from unbend_service.domain.tracing import trace_id_of


@dataclass(slots=True)
class Trace:
    """Of a request whose spans nobody wants."""

    trace_id: str

    def answered(self, name: str, code: str, failed: bool) -> None: ...


class NoTracer:
    """Port Tracer that only says which trace the caller is in."""

    @contextmanager
    def request(self, transport: str, name: str, request_id: str, traceparent: str | None) -> Iterator[Trace]:
        yield Trace(trace_id_of(traceparent))

    async def close(self) -> None: ...
