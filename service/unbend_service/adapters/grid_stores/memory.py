"""Grids kept in the memory of one process, least recently used first out."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from typing import Generic, TypeVar

from unbend_service.domain.errors import GridNotFound
from unbend_service.domain.records import GridRecord
from unbend_service.settings import Settings

V = TypeVar("V")


class MemoryGridStore:
    """Port GridStore; forgets everything with its process.

    Args:
        settings: ``grid_store_entries`` bounds grids and stream bindings each, ``grid_store_ttl_s`` counts from the
            last use.
        clock: seconds that only grow.
        entries: another bound than the setting.
    """

    def __init__(
        self, settings: Settings, clock: Callable[[], float] = time.monotonic, *, entries: int | None = None
    ) -> None:
        entries = settings.grid_store_entries if entries is None else entries
        self._grids = _Recent[GridRecord](entries, settings.grid_store_ttl_s, clock)
        self._streams = _Recent[str](entries, settings.grid_store_ttl_s, clock)
        self._cameras = _Recent[bytes](entries, settings.grid_store_ttl_s, clock)
        self._claims: dict[str, tuple[str, float]] = {}
        self._clock = clock

    async def put(self, record: GridRecord) -> None:
        self._grids.put(record.id, record)

    async def get(self, grid_id: str) -> GridRecord:
        """Raises GridNotFound."""
        record = self._grids.get(grid_id)
        if record is None:
            raise GridNotFound(f"No grid is stored as {grid_id!r}.")
        return record

    async def delete(self, grid_id: str) -> None:
        """Raises GridNotFound."""
        await self.get(grid_id)
        self._grids.remove(grid_id)

    async def bind_stream(self, stream_id: str, grid_id: str, *, replace: bool = True) -> str:
        """The grid id that is bound now; without ``replace`` the one that was, while its grid is kept."""
        if not replace and (bound := await self.stream_grid(stream_id)) is not None:
            return bound
        self._streams.put(stream_id, grid_id)
        return grid_id

    async def stream_grid(self, stream_id: str) -> str | None:
        """The grid id that was bound; None if there is none, or its grid is gone."""
        grid_id = self._streams.get(stream_id)
        return grid_id if grid_id is not None and self._grids.get(grid_id) is not None else None

    async def claim_stream(self, stream_id: str, token: str, lease_s: float) -> bool:
        """Whether ``token`` holds the claim, for ``lease_s`` seconds from now."""
        now = self._clock()
        self._claims = {known: claim for known, claim in self._claims.items() if claim[1] > now}
        if self._claims.get(stream_id, (token, 0.0))[0] != token:
            return False
        self._claims[stream_id] = (token, now + lease_s)
        return True

    async def release_stream(self, stream_id: str, token: str) -> None:
        if self._claims.get(stream_id, ("", 0.0))[0] == token:
            del self._claims[stream_id]

    async def camera(self, name: str) -> bytes | None:
        return self._cameras.get(name)

    async def swap_camera(self, name: str, known: bytes | None, value: bytes | None) -> bool:
        if self._cameras.get(name) != known:
            return False
        if value is None:
            self._cameras.remove(name)
        else:
            self._cameras.put(name, value)
        return True

    async def close(self) -> None:
        """Nothing is held that could be freed earlier than the store itself."""


class _Recent(Generic[V]):
    """Values by key, in the order of their last use."""

    def __init__(self, entries: int, ttl_s: float, clock: Callable[[], float]) -> None:
        self._entries = entries
        self._ttl_s = ttl_s
        self._clock = clock
        self._values: OrderedDict[str, tuple[float, V]] = OrderedDict()

    def put(self, key: str, value: V) -> None:
        self._values[key] = (self._clock(), value)
        self._values.move_to_end(key)
        self._forget()

    def get(self, key: str) -> V | None:
        self._forget()
        found = self._values.get(key)
        if found is None:
            return None
        self.put(key, found[1])
        return found[1]

    def remove(self, key: str) -> None:
        self._values.pop(key, None)

    def _forget(self) -> None:
        oldest = self._clock() - self._ttl_s
        while self._values:
            key, (used_at, _) = next(iter(self._values.items()))
            if used_at >= oldest and len(self._values) <= self._entries:
                break
            del self._values[key]
