"""Who may call, and what is counted and traced of a call."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Protocol

from unbend_service.application.ports.estimating import ModelInfo
from unbend_service.application.ports.rendering import PoolState
from unbend_service.domain.access import Grant


class TokenSource(Protocol):
    """The tokens that are accepted. Blocking."""

    def read(self) -> Sequence[Grant] | None:
        """All of them if they changed since the last call, else None.

        Raises:
            InvalidOption: they cannot be read; raised once for each change.
        """
        ...


class Meter(Protocol):
    """Counts what happens. Never blocks, never raises."""

    def request(self, transport: str, method: str, code: str, seconds: float) -> None: ...

    def stage(self, stage: str, seconds: float) -> None:
        """``stage`` is queue, decode, estimate, grid, render or encode."""
        ...

    def frame(self, result: str) -> None:
        """``result`` is corrected, left_alone, passed_through (its stream had no grid yet), dropped or failed."""
        ...

    def estimate(self, outcome: str) -> None:
        """One decision, ``corrected`` or ``left_alone``: once a picture or a stream, however many frames it took."""
        ...

    def stream_opened(self) -> None: ...

    def stream_closed(self) -> None: ...

    def rejected(self, reason: str) -> None: ...

    def worker_restarted(self, reason: str) -> None: ...

    def grid_cache(self, hit: bool) -> None: ...

    def grid_store(self, operation: str, result: str) -> None:
        """One call of a shared grid store; ``result`` is shared, local (the replica helped itself) or unreadable."""
        ...

    def grid_store_up(self, up: bool) -> None:
        """Whether the shared grid store answers, when that changes."""
        ...

    def pool(self, state: PoolState) -> None: ...

    def model(self, model: ModelInfo) -> None: ...

    def render(self) -> tuple[bytes, str]:
        """Everything counted so far as text for a scraper, and its content type."""
        ...


class RequestTrace(Protocol):
    """One request in its trace.

    Attributes:
        trace_id: 32 hexadecimal digits; empty where there is none.
    """

    trace_id: str

    def answered(self, name: str, code: str, failed: bool) -> None:
        """Says what the request was, and how it ended; ``failed``: through a fault of the service."""
        ...


class Tracer(Protocol):
    """Makes spans of requests. Never blocks, never raises."""

    def request(
        self, transport: str, name: str, request_id: str, traceparent: str | None
    ) -> AbstractContextManager[RequestTrace]:
        """Around a request; ``traceparent`` is what the caller says of his trace."""
        ...

    async def close(self) -> None:
        """Sends what waits, for a few seconds at most."""
        ...
