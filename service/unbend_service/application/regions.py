"""Memory that clients on the same host share with the service: registered, checked, and given back."""

from __future__ import annotations

import secrets

from unbend_service.application.ports import RenderPool, SharedMemory, SharedPicture
from unbend_service.domain.errors import InvalidRegion, RegionNotFound, TooManyRegions


class Regions:
    """Knows the memory of clients by ids that cannot be guessed.

    Args:
        pool: maps the memory.
        limit_bytes: bound on the memory of all clients together.
    """

    def __init__(self, pool: RenderPool, limit_bytes: int) -> None:
        self._pool = pool
        self._limit_bytes = limit_bytes
        self._regions: dict[str, SharedMemory] = {}

    def __len__(self) -> int:
        return len(self._regions)

    @property
    def size_bytes(self) -> int:
        """Bytes that are registered."""
        return sum(region.size_bytes for region in self._regions.values())

    def check_room(self, size_bytes: int) -> None:
        """Raises InvalidRegion or TooManyRegions for memory that could not be registered now."""
        if not 1 <= size_bytes <= self._limit_bytes:
            raise InvalidRegion(
                f"A region of {size_bytes} bytes.",
                allowed=f"1 to {self._limit_bytes} bytes",
                setting="local_memory_bytes",
            )
        used = self.size_bytes
        if used + size_bytes > self._limit_bytes:
            raise TooManyRegions(
                f"Clients share {used} bytes already; there is no room for {size_bytes} more.",
                allowed=f"{self._limit_bytes} bytes",
                setting="local_memory_bytes",
                retry_after_s=1.0,
            )

    def register(self, fd: int, size_bytes: int) -> str:
        """Maps memory and returns its id; the descriptor is the service's after :meth:`check_room`.

        Raises:
            InvalidRegion: it is not memory that stays, or smaller than it says.
        """
        region = self._pool.adopt(fd, size_bytes)
        region_id = "r" + secrets.token_hex(16)
        self._regions[region_id] = region
        return region_id

    def release(self, region_id: str) -> None:
        """Forgets a region; frames that are under way in it are finished before it is unmapped."""
        region = self._regions.pop(region_id, None)
        if region is not None:
            self._pool.disown(region)

    def picture(
        self, region_id: str, source_offset: int, target_offset: int, size_bytes: int, frame_bytes: int
    ) -> SharedPicture:
        """A picture of ``frame_bytes`` bytes in a region, and the place of its answer.

        Raises:
            RegionNotFound: there is no such region.
            InvalidRegion: the size is another, or a part is not inside the region, or both overlap.
        """
        region = self._regions.get(region_id)
        if region is None:
            raise RegionNotFound("No memory is registered under this id, or its connection has ended.")
        if size_bytes != frame_bytes:
            raise InvalidRegion(f"A picture of {size_bytes} bytes.", allowed=f"{frame_bytes} bytes, those of a frame")
        for name, offset in (("source_offset", source_offset), ("target_offset", target_offset)):
            if not 0 <= offset <= region.size_bytes - size_bytes:
                raise InvalidRegion(
                    f"{name}={offset} for {size_bytes} bytes in a region of {region.size_bytes}.",
                    allowed=f"0 to {region.size_bytes - size_bytes}"
                    if region.size_bytes >= size_bytes
                    else "a region that a frame fits into",
                )
        if abs(source_offset - target_offset) < size_bytes:
            raise InvalidRegion("The picture and its answer overlap.", allowed="places apart from each other")
        source = region.memory[source_offset : source_offset + size_bytes]
        source.flags.writeable = False
        target = region.memory[target_offset : target_offset + size_bytes]
        return SharedPicture(region, source_offset, target_offset, source, target)
