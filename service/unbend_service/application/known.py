"""Known: what was computed once for a content is not computed again."""

from __future__ import annotations

import asyncio
import hashlib
from collections import Counter, OrderedDict
from collections.abc import Awaitable, Callable
from typing import Generic, TypeVar

from unbend_service.application.ports import Bytes

V = TypeVar("V")

#: Hashing less than this takes less time than handing it to a thread.
HASHED_AT_ONCE_BYTES = 512 << 10


def digest(*parts: bytes | Bytes) -> bytes:
    """16 bytes that stand for the content of ``parts``; as good as never the same for two contents."""
    content = hashlib.sha256()  # processors have instructions for it: half the time of BLAKE2
    for part in parts:
        content.update(part if isinstance(part, bytes) else part.data)
    return content.digest()[:16]


class Known(Generic[V]):
    """Values by the digest of what they were computed from; single-flight, and bounded.

    Whoever asks while a value is being computed waits for that one computation. It is cancelled with the last who
    waits for it. An error reaches all of them and is not kept.

    Args:
        entries: values that are kept; the least recently asked for goes first. 0 keeps none.
    """

    def __init__(self, entries: int) -> None:
        self._entries = entries
        self._values: OrderedDict[bytes, V] = OrderedDict()
        self._under_way: dict[bytes, asyncio.Task[V]] = {}
        self._waiting: Counter[bytes] = Counter()

    def __len__(self) -> int:
        return len(self._values)

    async def get(self, key: bytes, compute: Callable[[], Awaitable[V]]) -> V:
        """The value of ``key``, from ``compute()`` if nobody has it; raises what that raises."""
        if key in self._values:
            self._values.move_to_end(key)
            return self._values[key]
        task = self._under_way.get(key)
        if task is None:
            task = asyncio.create_task(self._compute(key, compute))
            self._under_way[key] = task
            task.add_done_callback(_seen)
        self._waiting[key] += 1
        try:
            return await asyncio.shield(task)
        finally:
            self._waiting[key] -= 1
            if not self._waiting[key]:
                del self._waiting[key]
                task.cancel()
                if self._under_way.get(key) is task:
                    del self._under_way[key]

    async def _compute(self, key: bytes, compute: Callable[[], Awaitable[V]]) -> V:
        try:
            value = await compute()
        finally:
            if self._under_way.get(key) is asyncio.current_task():
                del self._under_way[key]
        self._values[key] = value
        while len(self._values) > self._entries:
            self._values.popitem(last=False)
        return value


def _seen(task: asyncio.Task[V]) -> None:
    """All who waited may have gone before the error came."""
    if not task.cancelled():
        task.exception()
