"""Answers that stay in shared memory, instead of being copied out, for as long as somebody holds them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress

import numpy as np

from unbend_service.adapters.renderers.slots import Slot, SlotPool
from unbend_service.application.ports import Bytes

#: Smaller answers are copied: that costs less than keeping account of a lease.
LEAST_LENT_BYTES = 256 << 10


class _Lease:
    """Base of the arrays that show a part of a slot; when the last of them goes, ``end`` is called."""

    def __init__(self, memory: Bytes, end: Callable[[], None]) -> None:
        self._memory = memory  # keeps the mapping open, even past the end of the pool
        self._end = end
        self.__array_interface__ = memory.__array_interface__

    def __del__(self) -> None:
        self._end()


class Lending:
    """Lends parts of slots and takes the slots back.

    Args:
        slots: where they come from.
        limit_bytes: of slots that are lent at once, so that holders can never keep all of the memory.
        on_return: called on the event loop when a slot is free again.
    """

    def __init__(self, slots: SlotPool, limit_bytes: int, on_return: Callable[[], None]) -> None:
        self._slots = slots
        self._limit_bytes = limit_bytes
        self._on_return = on_return
        self.lent_bytes = 0

    def lend(self, slot: Slot, first: int, end: int) -> Bytes | None:
        """A view of the bytes ``first`` to ``end`` of a slot in use, or None if they are to be copied instead.

        The slot is released when neither the view nor any view of it is held any more, in whatever thread that is.
        """
        if end - first < LEAST_LENT_BYTES or self.lent_bytes + slot.size_bytes > self._limit_bytes:
            return None
        loop = asyncio.get_running_loop()
        self.lent_bytes += slot.size_bytes

        def take_back() -> None:
            self.lent_bytes -= slot.size_bytes
            if not self._slots.closed:
                self._slots.release(slot)
                self._on_return()

        def tell() -> None:
            with suppress(RuntimeError):  # the loop is closed, and the pool with it
                loop.call_soon_threadsafe(take_back)

        return np.asarray(_Lease(slot.memory[first:end], tell))
