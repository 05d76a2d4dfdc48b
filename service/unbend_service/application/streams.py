"""The streams of the service: opened, resumed by their id, bounded in number, and ended together."""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from unbend_service.application.blocking import BlockingWork
from unbend_service.application.budget import FrameMemory
from unbend_service.application.correction import Correction
from unbend_service.application.estimation import Estimation
from unbend_service.application.ports import GridStore, ImageCodec, Meter
from unbend_service.application.regions import Regions
from unbend_service.application.stream_frames import FrameAnswers
from unbend_service.application.stream_grid import StreamGrid
from unbend_service.application.stream_messages import StreamConfig
from unbend_service.application.stream_session import StreamSession
from unbend_service.application.turns import Turns
from unbend_service.domain.errors import Draining, Resume, StreamTakenOver, TooManyStreams, UnbendError
from unbend_service.settings import Settings


class Streams:
    """Opens streams. A stream id has at most one session here: opening it again ends the older one.

    Attributes:
        memory: of the frames that all of them hold.
    """

    def __init__(
        self,
        estimation: Estimation,
        correction: Correction,
        store: GridStore,
        codec: ImageCodec,
        blocking: BlockingWork,
        meter: Meter,
        regions: Regions,
        settings: Settings,
    ) -> None:
        self._estimation = estimation
        self._correction = correction
        self._store = store
        self._codec = codec
        self._blocking = blocking
        self._meter = meter
        self._regions = regions
        self._settings = settings
        self._turns = Turns(max(1, settings.queue_frames // 2), settings.render_deadline_s)
        self.memory = FrameMemory(settings.stream_frames_bytes)
        self._live: dict[str, StreamSession] = {}
        self._draining = False

    @property
    def active(self) -> int:
        """Streams that are open."""
        return len(self._live)

    @asynccontextmanager
    async def open(self, config: StreamConfig) -> AsyncIterator[StreamSession]:
        """The session of one connection; whatever it holds is freed when the block is left.

        Raises:
            InvalidOption, InvalidFrame, UnsupportedPixelFormat, TooManyPixels, GridNotFound, InvalidGuides,
            InvalidGrid, FoldedGrid, NotServedHere: the stream cannot be as it was asked for.
            TooManyStreams, Draining: not now.
            StreamTakenOver, StreamIdle: later, inside the block, which is cancelled for it.
        """
        self._correction.check_offered()
        config.check(self._settings.source_pixels)
        if self._draining:
            raise Draining("The service is shutting down.", retry_after_s=0.1)
        stream_id = config.stream_id or f"s{secrets.token_hex(12)}"
        older = self._live.get(stream_id)
        if older is None and len(self._live) >= self._settings.streams:
            self._meter.rejected("too_many_streams")
            raise TooManyStreams(
                f"{len(self._live)} streams are open.",
                allowed=str(self._settings.streams),
                setting="streams",
                retry_after_s=1.0,
            )
        session = self._session(config, stream_id)
        self._live[stream_id] = session
        self._meter.stream_opened()
        try:
            if older is not None:
                older.end(StreamTakenOver(f"The stream {stream_id} was opened again by another connection."))
            session.resumed = await session.grid.prepare()
            yield session
        except asyncio.CancelledError:
            if session.ended_with is None or session.owner.uncancel() > 0:
                raise
            session.ended_with.resume = Resume(stream_id, session.last_index)
            raise session.ended_with from None
        except UnbendError as error:
            error.resume = Resume(stream_id, session.last_index)
            raise
        finally:
            if self._live.get(stream_id) is session:
                del self._live[stream_id]
            self._meter.stream_closed()
            await asyncio.shield(session.close())  # freed even if the owner is cancelled just now

    def drain(self) -> None:
        """Opens no further stream; the open ones answer what they accepted and end."""
        self._draining = True
        for session in list(self._live.values()):
            session.drain()

    def _session(self, config: StreamConfig, stream_id: str) -> StreamSession:
        owner = asyncio.current_task()
        assert owner is not None
        grid = StreamGrid(
            config,
            stream_id,
            self._estimation,
            self._correction,
            self._store,
            self._blocking,
            self._turns,
            self._settings,
        )
        answers = FrameAnswers(
            stream_id,
            config,
            grid,
            self._correction,
            self._codec,
            self._blocking,
            self._meter,
            self._turns,
            self._regions,
            self._settings,
        )
        return StreamSession(stream_id, config, grid, answers, owner, self.memory)
