"""Memory that requests under way may take together."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager

from unbend_service.domain.errors import MemoryFull

_RETRY_AFTER_S = 1.0


class Holding:
    """What one request has taken so far."""

    def __init__(self, budget: MemoryBudget) -> None:
        self._budget = budget
        self.size_bytes = 0

    def expect(self, size_bytes: int) -> None:
        """Raises MemoryFull if there is no room for ``size_bytes`` now; takes nothing, for they may never come."""
        self._budget.check(size_bytes)

    def grow(self, size_bytes: int) -> None:
        """Takes ``size_bytes`` more. Raises MemoryFull if they are not there."""
        self._budget.check(size_bytes)
        self._budget.used_bytes += size_bytes
        self.size_bytes += size_bytes


class MemoryBudget:
    """Bounds the bytes that all requests hold at once. For one thread, that of the event loop.

    Args:
        limit_bytes: of all of them together.
        setting: name of the setting that governs it.

    Attributes:
        used_bytes: taken now.
    """

    def __init__(self, limit_bytes: int, setting: str) -> None:
        self._limit_bytes = limit_bytes
        self._setting = setting
        self.used_bytes = 0

    @contextmanager
    def holding(self) -> Iterator[Holding]:
        """Around one request; whatever it took is given back at the end."""
        holding = Holding(self)
        try:
            yield holding
        finally:
            self.used_bytes -= holding.size_bytes

    def check(self, size_bytes: int) -> None:
        """Raises MemoryFull if there is no room for ``size_bytes``."""
        if self.used_bytes + size_bytes > self._limit_bytes:
            raise MemoryFull(
                f"The requests under way hold {self.used_bytes} bytes already.",
                allowed=f"{self._limit_bytes} bytes of all together",
                setting=self._setting,
                retry_after_s=_RETRY_AFTER_S,
            )


class FrameMemory:
    """Bounds the bytes of the frames that all streams hold at once: a stream that finds no room does not read on.

    A stream that holds no frame may read one all the same, so that none waits for another for ever. For one thread.

    Args:
        limit_bytes: of all of them together, but for one frame of each stream.

    Attributes:
        used_bytes: held now.
    """

    def __init__(self, limit_bytes: int) -> None:
        self._limit_bytes = limit_bytes
        self._given = asyncio.Event()
        self.used_bytes = 0

    def full(self, held_bytes: int) -> bool:
        """Whether a stream that holds ``held_bytes`` has to wait."""
        return held_bytes > 0 and self.used_bytes >= self._limit_bytes

    def take(self, size_bytes: int) -> None:
        """A frame was read; its size is known only now."""
        self.used_bytes += size_bytes

    def give(self, size_bytes: int) -> None:
        """A frame was answered, or went."""
        self.used_bytes -= size_bytes
        self._given.set()

    async def changed(self) -> None:
        """Waits until some stream gives memory back."""
        self._given.clear()
        await self._given.wait()
