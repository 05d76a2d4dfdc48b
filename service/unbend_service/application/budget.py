"""Memory that requests under way may take together."""

from __future__ import annotations

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
