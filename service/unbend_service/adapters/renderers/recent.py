"""Recent: what was used last, up to a bound in bytes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class Recent(Generic[K, V]):
    """Keeps values by key; the least recently used go when the bound is passed. The newest always stays.

    Args:
        capacity_bytes: the bound.
        discard: called with each value that goes, if there is something to do.
    """

    def __init__(self, capacity_bytes: int, discard: Callable[[V], None] | None = None) -> None:
        self._capacity_bytes = capacity_bytes
        self._discard = discard
        self._entries: OrderedDict[K, tuple[V, int]] = OrderedDict()
        self.size_bytes = 0

    def __len__(self) -> int:
        return len(self._entries)

    def get(self, key: K) -> V | None:
        entry = self._entries.get(key)
        if entry is None:
            return None
        self._entries.move_to_end(key)
        return entry[0]

    def put(self, key: K, value: V, size_bytes: int) -> V:
        """Keeps ``value`` under a key that is not there yet."""
        self._entries[key] = value, size_bytes
        self.size_bytes += size_bytes
        while self.size_bytes > self._capacity_bytes and len(self._entries) > 1:
            self._drop_oldest()
        return value

    def clear(self) -> None:
        while self._entries:
            self._drop_oldest()

    def _drop_oldest(self) -> None:
        _, (value, size_bytes) = self._entries.popitem(last=False)
        self.size_bytes -= size_bytes
        if self._discard is not None:
            self._discard(value)
