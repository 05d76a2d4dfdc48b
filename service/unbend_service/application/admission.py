"""Who is let in: nobody once the service drains."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from unbend_service.domain.errors import Draining


class Admission:
    """Counts the calls under way and refuses new ones while draining."""

    def __init__(self) -> None:
        self._active = 0
        self._draining = False
        self._idle = asyncio.Event()
        self._idle.set()
        self._listeners: list[Callable[[], None]] = []

    def on_drain(self, listener: Callable[[], None]) -> None:
        """Calls ``listener`` when draining begins, for calls that would not end by themselves."""
        self._listeners.append(listener)

    @property
    def draining(self) -> bool:
        return self._draining

    @property
    def active(self) -> int:
        """Calls under way."""
        return self._active

    @contextmanager
    def admitted(self) -> Iterator[None]:
        """Around one call. Raises Draining."""
        if self._draining:
            raise Draining("The service is shutting down.", retry_after_s=1.0)
        self._active += 1
        self._idle.clear()
        try:
            yield
        finally:
            self._active -= 1
            if not self._active:
                self._idle.set()

    async def drain(self, grace_s: float) -> bool:
        """Refuses new calls and waits for those under way; False if some are left after ``grace_s`` seconds."""
        if not self._draining:
            self._draining = True
            for listener in self._listeners:
                listener()
        try:
            await asyncio.wait_for(self._idle.wait(), grace_s)
        except TimeoutError:
            return False
        return True
