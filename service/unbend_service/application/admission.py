"""Who is let in: nobody once the service drains, and no more single calls at once than it can answer soon."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from unbend_service.domain.errors import Draining, QueueFull

_MEAN_OF_CALLS = 0.1


class Admission:
    """Counts the calls under way and refuses new ones while draining.

    A single call is refused here, before its picture is looked at, or not at all: what was let in finds room in every
    queue behind.

    Args:
        singles: calls for single pictures and grids that may be under way at once; streams are bounded elsewhere.
    """

    def __init__(self, singles: int = 1 << 30) -> None:
        self._singles_at_most = singles
        self._singles = 0
        self._mean_call_s = 0.1
        self._active = 0
        self._leaving = False
        self._draining = False
        self._idle = asyncio.Event()
        self._idle.set()
        self._listeners: list[Callable[[], None]] = []

    def on_drain(self, listener: Callable[[], None]) -> None:
        """Calls ``listener`` when draining begins, for calls that would not end by themselves."""
        self._listeners.append(listener)

    @property
    def leaving(self) -> bool:
        """Whether the service will drain, or does: balancers and callers had better go elsewhere."""
        return self._leaving

    @property
    def draining(self) -> bool:
        return self._draining

    def leave(self) -> None:
        """Says that draining comes soon; calls are let in until it does."""
        self._leaving = True

    @property
    def active(self) -> int:
        """Calls under way."""
        return self._active

    @contextmanager
    def admitted(self, *, single: bool = False) -> Iterator[None]:
        """Around one call. Raises Draining, and QueueFull for one ``single`` call too many."""
        if self._draining:
            raise Draining("The service is shutting down.", retry_after_s=1.0)
        if single and self._singles >= self._singles_at_most:
            raise QueueFull(
                f"{self._singles} calls are under way already.",
                setting="queue_frames",
                retry_after_s=round(max(0.1, self._mean_call_s), 1),
            )
        self._active += 1
        self._singles += single
        self._idle.clear()
        start_s = asyncio.get_running_loop().time()
        try:
            yield
        finally:
            self._active -= 1
            self._singles -= single
            if single:
                self._mean_call_s += _MEAN_OF_CALLS * (asyncio.get_running_loop().time() - start_s - self._mean_call_s)
            if not self._active:
                self._idle.set()

    async def drain(self, grace_s: float) -> bool:
        """Refuses new calls and waits for those under way; False if some are left after ``grace_s`` seconds."""
        if not self._draining:
            self._leaving = self._draining = True
            for listener in self._listeners:
                listener()
        try:
            await asyncio.wait_for(self._idle.wait(), grace_s)
        except TimeoutError:
            return False
        return True
