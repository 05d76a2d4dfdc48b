"""Shared memory that bodies travel to a decoder in and pixels come back in."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable

import numpy as np

from unbend_service.adapters.renderers.slots import Slot, slot_class_bytes
from unbend_service.application.ports import Bytes
from unbend_service.domain.errors import MemoryFull, Unavailable

_RETRY_AFTER_S = 1.0
#: Nothing was decoded for as long: what is kept warm is given back.
_REST_S = 10.0


class _Loan:
    """Base of the arrays that show a sheet; when the last of them goes, the sheet is free again."""

    def __init__(self, memory: Bytes, end: Callable[[], None]) -> None:
        self._memory = memory
        self._end = end
        self.__array_interface__ = memory.__array_interface__

    def __del__(self) -> None:
        self._end()


class Sheets:
    """Pieces of shared memory, used again while they are warm. Thread-safe.

    Args:
        limit_bytes: of all that are in use; ``setting`` governs it.
        kept_bytes: of those that are kept for the next time.
        rest_s: after which without a picture none is kept.
    """

    def __init__(self, limit_bytes: int, kept_bytes: int, setting: str, rest_s: float = _REST_S) -> None:
        self._limit_bytes = limit_bytes
        self._kept_bytes = kept_bytes
        self._setting = setting
        self._lock = threading.Lock()
        self._free: deque[Slot] = deque()
        # a loan may end wherever an array dies, also in a thread that holds the lock: appending needs none
        self._returned: deque[Slot] = deque()
        self._made = 0
        self._closed = False
        self._rest_s = rest_s
        self._resting: threading.Timer | None = None
        self._asked_s = 0.0
        self.used_bytes = 0

    def acquire(self, size_bytes: int) -> Slot:
        """A sheet of at least ``size_bytes``.

        Raises:
            MemoryFull: those in use leave no room for it.
            Unavailable: the kernel refuses.
        """
        wanted = slot_class_bytes(size_bytes)
        with self._lock:
            self._asked_s = time.monotonic()
            if self._resting is None:
                self._look_later(self._rest_s)
            self._take_back()
            if self.used_bytes + wanted > self._limit_bytes:
                raise MemoryFull(
                    f"Decoded pictures take {self.used_bytes} bytes already.",
                    allowed=f"{self._limit_bytes} bytes of all together",
                    setting=self._setting,
                    retry_after_s=_RETRY_AFTER_S,
                )
            self.used_bytes += wanted
            for slot in self._free:
                if slot.size_bytes == wanted:
                    self._free.remove(slot)
                    return slot
            self._made += 1
            number = self._made
        try:
            return Slot.create(number, wanted)
        except OSError as error:
            with self._lock:
                self.used_bytes -= wanted
            raise Unavailable(f"The system gives no shared memory: {error.strerror}.") from error

    def release(self, slot: Slot) -> None:
        """Makes a sheet free."""
        self._returned.append(slot)
        if self._lock.acquire(blocking=False):
            try:
                self._take_back()
            finally:
                self._lock.release()

    def lend(self, slot: Slot, size_bytes: int) -> Bytes:
        """The first bytes of a sheet, (size_bytes,) uint8; it is released when nobody looks at them any more."""
        return np.asarray(_Loan(slot.memory[:size_bytes], lambda: self.release(slot)))

    def close(self) -> None:
        """Frees what nobody looks at now, and what is looked at later."""
        with self._lock:
            self._closed = True
            if self._resting is not None:
                self._resting.cancel()
            self._take_back()

    def _look_later(self, pause_s: float) -> None:
        # begun where a sheet is asked for: where a loan ends no thread may be started
        if not self._closed:
            self._resting = threading.Timer(pause_s, self._rest)
            self._resting.daemon = True
            self._resting.start()

    def _rest(self) -> None:
        """Gives back what is kept, unless something was asked for lately; looks again while something is in use."""
        with self._lock:
            self._resting = None
            self._take_back()
            left_s = self._asked_s + self._rest_s - time.monotonic()
            if left_s > 0:
                self._look_later(left_s)
                return
            while self._free:
                self._free.popleft().close()
            if self.used_bytes:
                self._look_later(self._rest_s)

    def _take_back(self) -> None:
        while self._returned:
            slot = self._returned.popleft()
            self.used_bytes -= slot.size_bytes
            self._free.append(slot)
        bound = 0 if self._closed else self._kept_bytes
        while self._free and sum(slot.size_bytes for slot in self._free) > bound:
            self._free.popleft().close()
