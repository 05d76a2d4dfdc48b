"""Which of the sessions that have opened one stream id estimates its grid."""

from __future__ import annotations

import asyncio
import random
import secrets

from unbend_service.application.ports import GridStore
from unbend_service.domain.errors import GridNotFound
from unbend_service.domain.records import GridRecord

_LOOK_EVERY_S = 0.05


class StreamLead:
    """One session's part in the estimate of a stream, among all replicas that share the grid store.

    One session leads and estimates; the others wait for its grid. A leader that dies is succeeded once its lease is
    over; one that only seemed dead finds its estimate late, and takes the grid that the stream was given.
    """

    def __init__(self, store: GridStore, stream_id: str, lease_s: float) -> None:
        self._store = store
        self._stream_id = stream_id
        self._lease_s = lease_s
        self._token = secrets.token_hex(16)
        self._renewing: asyncio.Task[None] | None = None
        self._asked = False

    async def bound_record(self) -> GridRecord | None:
        """The grid that the stream was given, None if it has none (any more)."""
        grid_id = await self._store.stream_grid(self._stream_id)
        if grid_id is None:
            return None
        try:
            return await self._store.get(grid_id)
        except GridNotFound:
            return None

    async def win(self) -> GridRecord | None:
        """None once the estimate is this session's to make; the grid, if another session has made it before."""
        while True:
            self._asked = True
            leads = await self._store.claim_stream(self._stream_id, self._token, self._lease_s)
            if leads:
                self._renewing = asyncio.create_task(self._renew())
            bound = await self.bound_record()
            if bound is not None:
                await self.release()
                return bound
            if leads:
                return None
            await asyncio.sleep(_LOOK_EVERY_S * random.uniform(0.8, 1.2))

    async def bind(self, record: GridRecord, *, replace: bool) -> GridRecord:
        """Gives the stream its grid; returns the one that it has now, which may be that of an earlier estimate."""
        bound = await self._store.bind_stream(self._stream_id, record.id, replace=replace)
        await self.release()
        if bound == record.id:
            return record
        try:
            return await self._store.get(bound)
        except GridNotFound:
            await self._store.bind_stream(self._stream_id, record.id)
            return record

    async def release(self) -> None:
        """Lets another session lead."""
        if self._renewing is not None:
            self._renewing.cancel()
            await asyncio.gather(self._renewing, return_exceptions=True)
            self._renewing = None
        if self._asked:  # perhaps it was won, and the answer was not waited for
            self._asked = False
            await self._store.release_stream(self._stream_id, self._token)

    async def _renew(self) -> None:
        while True:
            await asyncio.sleep(self._lease_s / 3)
            await self._store.claim_stream(self._stream_id, self._token, self._lease_s)
