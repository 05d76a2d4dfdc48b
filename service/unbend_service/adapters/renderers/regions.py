"""Memory that clients own and the workers draw in."""

from __future__ import annotations

import fcntl
import mmap
import os
from collections.abc import Callable, Iterable

from unbend_service.adapters.renderers.slots import Slot
from unbend_service.application.ports import SharedMemory
from unbend_service.domain.errors import InvalidRegion, RegionNotFound


class Region(Slot):
    """Memory of a client; mapped as a slot is.

    Attributes:
        users: frames under way in it.
        given_up: whether the client has gone.
    """

    users = 0
    given_up = False

    def enter(self) -> None:
        """A frame in it is under way. Raises RegionNotFound when the client has gone."""
        if self.given_up:
            raise RegionNotFound("The client has taken its memory back.")
        self.users += 1


class RegionKeeper:
    """Maps regions, and closes each once its client has gone and no frame is under way in it.

    Args:
        number: gives numbers, unlike those of slots.
        unmap: tells the workers that regions are gone.
    """

    def __init__(self, number: Callable[[], int], unmap: Callable[[Iterable[int]], None]) -> None:
        self._number = number
        self._unmap = unmap
        self._regions: set[Region] = set()

    def adopt(self, fd: int, size_bytes: int) -> Region:
        """See :class:`~unbend_service.application.ports.RenderPool`."""
        try:
            check_memory(fd, size_bytes)
            region = Region(self._number(), fd, size_bytes)
        except BaseException as error:
            os.close(fd)
            if isinstance(error, OSError):
                raise InvalidRegion(
                    f"The memory cannot be mapped: {error.strerror}.", allowed="memory that may be read and written"
                ) from error
            raise
        self._regions.add(region)
        return region

    def known(self, memory: SharedMemory) -> Region:
        """The region that this memory is. Raises RegionNotFound."""
        if isinstance(memory, Region) and memory in self._regions:
            return memory
        raise RegionNotFound("The client has taken its memory back.")

    def leave(self, region: Region) -> None:
        """A frame in it is no longer under way."""
        region.users -= 1
        self._close_unused(region)

    def disown(self, memory: SharedMemory) -> None:
        """See :class:`~unbend_service.application.ports.RenderPool`."""
        if isinstance(memory, Region):
            memory.given_up = True
            self._close_unused(memory)

    def close(self) -> None:
        """Closes everything, also what is in use."""
        for region in self._regions:
            region.given_up = True
            region.close()
        self._regions.clear()

    def _close_unused(self, region: Region) -> None:
        if region.given_up and not region.users and region in self._regions:
            self._regions.discard(region)
            self._unmap([region.number])
            region.close()


def check_memory(fd: int, size_bytes: int) -> None:
    """Raises InvalidRegion unless the descriptor is plain memory that has ``size_bytes`` and can never have less.

    A mapped file that shrinks kills whoever touches what is gone, and a file system of the client's own making could
    hold up whoever reads; a sealed memfd does neither.
    """
    needed = "a memfd of pages of the usual size, sealed with F_SEAL_SHRINK"
    try:
        seals = fcntl.fcntl(fd, fcntl.F_GET_SEALS)
    except OSError:
        raise InvalidRegion("The descriptor is not memory that can be sealed.", allowed=needed) from None
    if not seals & fcntl.F_SEAL_SHRINK:
        raise InvalidRegion("The memory is not sealed against shrinking.", allowed=needed)
    if os.fstatvfs(fd).f_bsize != mmap.PAGESIZE:
        raise InvalidRegion("The memory has huge pages.", allowed=needed)
    actual = os.fstat(fd).st_size
    if actual < size_bytes:
        raise InvalidRegion(f"The memory has {actual} bytes, not {size_bytes}.", allowed=f"1 to {actual} bytes")
