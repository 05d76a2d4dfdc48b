"""A shared grid store that may fail, and what a replica does meanwhile."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import Protocol, TypeVar

import structlog

from unbend_service.adapters.grid_stores.memory import MemoryGridStore
from unbend_service.application.ports import GridStore, Meter
from unbend_service.domain.errors import GridNotFound, GridStoreUnavailable
from unbend_service.domain.records import GridRecord

R = TypeVar("R")

log = structlog.get_logger(__name__)


class SharedGridStore(GridStore, Protocol):
    """A grid store elsewhere: each of its calls may raise GridStoreUnavailable, after a bounded time."""

    async def ping(self) -> None: ...


class ShelteredGridStore:
    """Port GridStore; asks the shared store, and helps itself while that does not answer.

    After the first failure no call waits for the shared store any more: it is tried in the background, and what was
    stored meanwhile is handed in before it is asked again. During the outage the replica knows the grids that it stored
    or used itself. A stream that it does not know is estimated again; a grid that it does not know is not available; a
    deletion is refused. The grid that a stream had before the outage wins over one that was estimated in it.

    Args:
        shared: asked first.
        local: what this replica knows; bounds what is handed in later as well.
        retry_s: pause between attempts to reach the shared store.
    """

    def __init__(
        self, shared: SharedGridStore, local: MemoryGridStore, meter: Meter, *, retry_s: float, owed_entries: int
    ) -> None:
        self._shared = shared
        self._local = local
        self._meter = meter
        self._retry_s = retry_s
        self._owed_entries = owed_entries
        self._owed_grids: OrderedDict[str, None] = OrderedDict()
        self._owed_bindings: OrderedDict[str, tuple[str, bool]] = OrderedDict()
        self._mending: asyncio.Task[None] | None = None

    async def put(self, record: GridRecord) -> None:
        await self._local.put(record)
        try:
            await self._ask("put", lambda: self._shared.put(record))
        except GridStoreUnavailable:
            self._owe(self._owed_grids, record.id, None)

    async def get(self, grid_id: str) -> GridRecord:
        """Raises GridNotFound; GridStoreUnavailable for a grid that only the shared store may know."""
        try:
            record = await self._ask("get", lambda: self._shared.get(grid_id))
        except GridStoreUnavailable:
            with suppress(GridNotFound):
                return await self._local.get(grid_id)
            raise
        await self._local.put(record)
        return record

    async def delete(self, grid_id: str) -> None:
        """Raises GridNotFound; GridStoreUnavailable, for other replicas would still have the grid."""
        await self._ask("delete", lambda: self._shared.delete(grid_id))
        with suppress(GridNotFound):
            await self._local.delete(grid_id)

    async def bind_stream(self, stream_id: str, grid_id: str, *, replace: bool = True) -> str:
        """The grid id that is bound now; without ``replace`` the one that was, while its grid is kept."""
        try:
            bound = await self._ask("bind", lambda: self._shared.bind_stream(stream_id, grid_id, replace=replace))
        except GridStoreUnavailable:
            bound = await self._local.bind_stream(stream_id, grid_id, replace=replace)
            self._owe(self._owed_bindings, stream_id, (bound, replace))
            return bound
        return await self._local.bind_stream(stream_id, bound)

    async def stream_grid(self, stream_id: str) -> str | None:
        """The grid id that was bound; None if there is none, its grid is gone, or only the shared store knows."""
        try:
            bound = await self._ask("stream", lambda: self._shared.stream_grid(stream_id))
        except GridStoreUnavailable:
            return await self._local.stream_grid(stream_id)
        if bound is not None:
            await self._local.bind_stream(stream_id, bound)
        return bound

    async def claim_stream(self, stream_id: str, token: str, lease_s: float) -> bool:
        """Whether ``token`` holds the claim; among the streams of this replica only while it is on its own."""
        try:
            return await self._ask("claim", lambda: self._shared.claim_stream(stream_id, token, lease_s))
        except GridStoreUnavailable:
            return await self._local.claim_stream(stream_id, token, lease_s)

    async def release_stream(self, stream_id: str, token: str) -> None:
        await self._local.release_stream(stream_id, token)
        if self._mending is None:
            try:
                await self._shared.release_stream(stream_id, token)
            except GridStoreUnavailable as error:
                self._fail(error)  # the claim lapses by itself

    async def camera(self, name: str) -> bytes | None:
        """What this replica saw of the camera while it is on its own."""
        try:
            return await self._ask("camera", lambda: self._shared.camera(name))
        except GridStoreUnavailable:
            return await self._local.camera(name)

    async def swap_camera(self, name: str, known: bytes | None, value: bytes | None) -> bool:
        """Pictures that are seen during an outage count here, and are not handed in."""
        try:
            return await self._ask("camera", lambda: self._shared.swap_camera(name, known, value))
        except GridStoreUnavailable:
            return await self._local.swap_camera(name, await self._local.camera(name), value)

    async def close(self) -> None:
        if self._mending is not None:
            self._mending.cancel()
            await asyncio.gather(self._mending, return_exceptions=True)
        await self._shared.close()
        await self._local.close()

    async def _ask(self, operation: str, work: Callable[[], Awaitable[R]]) -> R:
        if self._mending is not None:
            self._meter.grid_store(operation, "local")
            raise GridStoreUnavailable("The shared grid store does not answer.", retry_after_s=self._retry_s)
        try:
            result = await work()
        except GridStoreUnavailable as error:
            self._meter.grid_store(operation, "local")
            self._fail(error)
            raise
        except GridNotFound:
            self._meter.grid_store(operation, "shared")
            raise
        self._meter.grid_store(operation, "shared")
        return result

    def _owe(self, owed: OrderedDict[str, R], key: str, value: R) -> None:
        owed[key] = value
        owed.move_to_end(key)
        while len(owed) > self._owed_entries:
            owed.popitem(last=False)

    def _fail(self, error: GridStoreUnavailable) -> None:
        if self._mending is not None:
            return
        log.warning("shared grid store does not answer", error=error.message)
        self._meter.grid_store_up(False)
        self._mending = asyncio.create_task(self._mend())

    async def _mend(self) -> None:
        while True:
            await asyncio.sleep(self._retry_s)
            try:
                await self._shared.ping()
                handed_in = await self._hand_in()
            except GridStoreUnavailable:
                continue
            break
        self._mending = None  # before anything else can be owed: there is no await in between
        self._meter.grid_store_up(True)
        log.info("shared grid store answers again", handed_in=handed_in)

    async def _hand_in(self) -> int:
        """Stores what is owed, grids before the streams that refer to them; what fails is owed on."""
        count = 0
        while self._owed_grids or self._owed_bindings:
            if self._owed_grids:
                grid_id = next(iter(self._owed_grids))
                with suppress(GridNotFound):  # no longer known here either
                    await self._shared.put(await self._local.get(grid_id))
                self._owed_grids.pop(grid_id, None)
            else:
                stream_id, (grid_id, replace) = next(iter(self._owed_bindings.items()))
                bound = await self._shared.bind_stream(stream_id, grid_id, replace=replace)
                await self._local.bind_stream(stream_id, bound)
                if self._owed_bindings.get(stream_id) == (grid_id, replace):
                    del self._owed_bindings[stream_id]
            count += 1
        return count
