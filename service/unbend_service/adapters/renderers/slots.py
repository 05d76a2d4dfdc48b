"""Shared memory for frames on their way to a worker and back. The parent owns it; workers only map it.

A slot is a ``memfd``: memory with a file descriptor and no name. Nothing can be left behind in /dev/shm, however the
parent ends, and the small /dev/shm of a container is no limit. The descriptor goes to a worker over its socket.
"""

from __future__ import annotations

import fcntl
import mmap
import os
from collections import OrderedDict
from contextlib import suppress

import numpy as np

from unbend_service.application.ports import Bytes
from unbend_service.domain.errors import RendererUnavailable

_SMALLEST_BYTES = 64 << 10


def slot_class_bytes(size_bytes: int) -> int:
    """Size of the slots that serve ``size_bytes``: the next of four steps per power of two, so waste is at most 1/4."""
    if size_bytes <= _SMALLEST_BYTES:
        return _SMALLEST_BYTES
    step = 1 << ((size_bytes - 1).bit_length() - 3)
    return -(-size_bytes // step) * step


class Slot:
    """One piece of shared memory.

    Attributes:
        number: unlike that of any other slot of the pool, ever.
        fd: the memory's descriptor.
        size_bytes: its size.
        memory: (size_bytes,) uint8 view, writable.
    """

    def __init__(self, number: int, fd: int, size_bytes: int) -> None:
        self.number = number
        self.fd = fd
        self.size_bytes = size_bytes
        self._map = mmap.mmap(fd, size_bytes)
        self.memory: Bytes = np.frombuffer(self._map, dtype=np.uint8)

    @classmethod
    def create(cls, number: int, size_bytes: int) -> Slot:
        """Raises OSError where the kernel gives no memory or no descriptor."""
        fd = os.memfd_create(f"unbend-slot-{number}", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        try:
            os.ftruncate(fd, size_bytes)
            # who is handed the descriptor cannot take the memory away under those who look at it
            fcntl.fcntl(fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL)
            return cls(number, fd, size_bytes)
        except BaseException:
            os.close(fd)
            raise

    def close(self) -> None:
        """Gives the memory back, or leaves that to the last view of ``memory`` that somebody holds."""
        del self.memory
        with suppress(BufferError):
            self._map.close()
        del self._map  # it keeps a descriptor of its own
        os.close(self.fd)


class SlotPool:
    """Slots by size class; released ones are used again.

    Args:
        limit_bytes: bound on the memory of all slots together, used or not.
    """

    def __init__(self, limit_bytes: int) -> None:
        self._limit_bytes = limit_bytes
        self._free: OrderedDict[int, Slot] = OrderedDict()
        self._used: dict[int, Slot] = {}
        self._made = 0
        self._dropped: list[int] = []
        self.size_bytes = 0
        self.closed = False

    def next_number(self) -> int:
        """A number that no slot has or will have."""
        self._made += 1
        return self._made

    @property
    def used(self) -> int:
        """Slots that are in use."""
        return len(self._used)

    def acquire(self, size_bytes: int) -> Slot | None:
        """A slot of at least ``size_bytes``, None while those in use leave no room for it.

        Raises:
            RendererUnavailable: it would not fit even if no other were in use, or the kernel refuses.
        """
        wanted = slot_class_bytes(size_bytes)
        if wanted > self._limit_bytes:
            raise RendererUnavailable(
                f"The frame needs {wanted} bytes of shared memory, more than is allowed.",
                allowed=f"up to {self._limit_bytes} bytes",
                setting="shared_memory_bytes",
            )
        fitting = next((slot for slot in reversed(self._free.values()) if slot.size_bytes == wanted), None)
        if fitting is not None:
            del self._free[fitting.number]
        else:
            while self._free and self.size_bytes + wanted > self._limit_bytes:
                self._drop(self._free.popitem(last=False)[1])
            if self.size_bytes + wanted > self._limit_bytes:
                return None
            try:
                fitting = Slot.create(self.next_number(), wanted)
            except OSError as error:
                raise RendererUnavailable(
                    f"The system gives no shared memory: {error.strerror}.", setting="shared_memory_bytes"
                ) from error
            self.size_bytes += wanted
        self._used[fitting.number] = fitting
        return fitting

    def release(self, slot: Slot) -> None:
        """Makes the slot free for the next frame."""
        self._free[slot.number] = self._used.pop(slot.number)

    def drop_free(self) -> None:
        """Gives the memory of all free slots back."""
        while self._free:
            self._drop(self._free.popitem()[1])

    def take_dropped(self) -> list[int]:
        """Numbers of the slots that went since the last call, for the workers to unmap."""
        dropped, self._dropped = self._dropped, []
        return dropped

    def close(self) -> None:
        """Frees everything, also what is in use; memory that somebody still looks at goes with the last look."""
        self.closed = True
        for slot in (*self._free.values(), *self._used.values()):
            self._drop(slot)
        self._free.clear()
        self._used.clear()

    def _drop(self, slot: Slot) -> None:
        self.size_bytes -= slot.size_bytes
        self._dropped.append(slot.number)
        slot.close()
