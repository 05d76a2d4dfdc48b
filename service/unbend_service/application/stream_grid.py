"""How a stream comes by its grid."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

from unbend_service.application.blocking import BlockingWork
from unbend_service.application.correction import Correction, leaves_alone
from unbend_service.application.estimation import ESTIMATE_LONGEST_PX, Estimation, fused_estimate
from unbend_service.application.grey import grey_of_frame
from unbend_service.application.ports import Bytes, Estimate, GridStore
from unbend_service.application.stream_lead import StreamLead
from unbend_service.application.stream_messages import DrawnGuides, EstimateOver, StoredGrid, StreamConfig
from unbend_service.application.turns import Turns
from unbend_service.domain.decision import spin_grid
from unbend_service.domain.frames import Frame
from unbend_service.domain.grid import Grid
from unbend_service.domain.records import Correct, GridRecord
from unbend_service.settings import Settings


@dataclass(frozen=True, slots=True)
class FixedGrid:
    """The grid of a stream, fixed.

    Attributes:
        record: before fit and strength.
        fitted: as it is rendered; None if the stream is left alone.
    """

    record: GridRecord
    fitted: Grid | None


class StreamGrid:
    """Fixes the grid of one stream: stored, drawn, remembered for the stream id, or estimated over its first frames.

    An estimate is over N frames, but never waits for frames that will not come: it is made from what is there when the
    stream ends, when no more frames can be read because all that may be in flight wait for the grid, or when no frame
    came for a while. Frames that cannot be decoded do not count.

    Raises, from :meth:`prepare`, :meth:`now` and :meth:`fixed`, whatever made the grid impossible.
    """

    def __init__(
        self,
        config: StreamConfig,
        stream_id: str,
        estimation: Estimation,
        correction: Correction,
        store: GridStore,
        blocking: BlockingWork,
        turns: Turns,
        settings: Settings,
    ) -> None:
        self._config = config
        self._stream_id = stream_id
        self._estimation = estimation
        self._correction = correction
        self._store = store
        self._blocking = blocking
        self._turns = turns
        self._settings = settings
        self._fixed: asyncio.Future[FixedGrid] = asyncio.get_running_loop().create_future()
        self._wanted = settings.stream_estimate_frames
        self._expected = 0
        self._offered = 0
        self._complete = False
        self._deciding = False
        self._estimates: list[Estimate] = []
        self._tasks: set[asyncio.Task[None]] = set()
        self._timer: asyncio.TimerHandle | None = None
        self._may_be_known = bool(config.stream_id) and not config.estimate_again
        self._lead = StreamLead(store, stream_id, settings.stream_lease_s)
        self._winning: asyncio.Task[GridRecord | None] | None = None

    async def prepare(self) -> bool:
        """Fixes the grid if that takes no frame; returns whether the stream id was known and its grid is reused."""
        source, bound = self._config.grid_source, None
        if self._may_be_known:
            bound = await self._lead.bound_record()
        if isinstance(source, EstimateOver):
            self._wanted = source.frames or self._settings.stream_estimate_frames
            if bound is not None:
                self._fixed.set_result(await self._fit(bound))
            return bound is not None
        record = await (self._drawn(source) if isinstance(source, DrawnGuides) else self._stored(source))
        await self._store.bind_stream(self._stream_id, record.id)
        self._fixed.set_result(await self._fit(record))
        return bound is not None and bound.id == record.id

    def now(self) -> FixedGrid | None:
        """The grid if it is fixed."""
        return self._fixed.result() if self._fixed.done() else None

    async def fixed(self) -> FixedGrid:
        """The grid, once it is fixed."""
        return await asyncio.shield(self._fixed)

    async def last_chance(self) -> FixedGrid | None:
        """The grid of a stream that ended: waits for an estimate that is under way, but not for frames."""
        return await self.fixed() if self._fixed.done() or self._offered else None

    def expect(self) -> None:
        """A frame was taken on: it will be offered or is lost."""
        self._expected += 1
        if not self._fixed.done():
            self._rearm()

    def lose(self) -> None:
        """A frame that was expected cannot be offered."""
        self._expected -= 1
        self._settle()

    async def offer(self, frame: Frame) -> None:
        """A frame that was expected is here; it is looked at if another estimate is wanted.

        Returns once the frame is no longer needed, so that its bytes count among those in flight.
        """
        self._expected -= 1
        if not self._deciding and self._offered < self._wanted:
            self._offered += 1
            try:
                grey = await self._turns.run(
                    self._stream_id, lambda: self._blocking.run("decode", grey_of_frame, frame, ESTIMATE_LONGEST_PX)
                )
            except BaseException:
                self._offered -= 1
                self._settle()
                raise
            self._track(asyncio.create_task(self._estimate(grey)))
        self._settle()

    def complete(self) -> None:
        """No further frame will come before the grid is fixed: make do with those that are expected."""
        if not self._fixed.done():
            self._complete = True
            self._settle()

    async def close(self) -> None:
        """Ends what is under way."""
        self._deciding = True  # an estimate that ends only now must not begin a decision
        if self._timer is not None:
            self._timer.cancel()
        tasks = [*self._tasks, *filter(None, [self._winning])]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await self._lead.release()
        self._fixed.cancel()

    def _rearm(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = asyncio.get_running_loop().call_later(self._settings.stream_estimate_wait_s, self.complete)

    def _settle(self) -> None:
        if self._deciding or not self._enough or len(self._estimates) < self._offered:
            return
        if not self._estimates:
            self._complete = False  # every frame so far was broken: the next ones are as good as the first
        else:
            self._deciding = True
            self._track(asyncio.create_task(self._decide()))

    @property
    def _enough(self) -> bool:
        return self._offered >= self._wanted or (self._complete and self._expected == 0)

    def _track(self, task: asyncio.Task[None]) -> None:
        self._tasks.add(task)
        task.add_done_callback(self._finished)

    def _finished(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None and not self._fixed.done():
            self._fixed.set_exception(error)
            self._fixed.exception()  # retrieved: not every stream lives long enough to ask
        else:
            self._settle()

    async def _estimate(self, grey: Bytes) -> None:
        if await self._leads():
            self._estimates.append(await self._turns.run(self._stream_id, lambda: self._estimation.of_grey(grey)))

    async def _leads(self) -> bool:
        """Whether the estimate is to be made here; else the grid of the session that made it is taken over."""
        if not self._may_be_known:
            return True
        if self._winning is None:
            self._winning = asyncio.create_task(self._lead.win())
        made = await asyncio.shield(self._winning)
        if made is None:
            return True
        if not self._deciding:
            self._deciding = True
            self._fix(await self._fit(made))
        return False

    async def _decide(self) -> None:
        options = self._config.options
        combined = await self._turns.run(
            self._stream_id, lambda: self._blocking.run("grid", fused_estimate, self._estimates)
        )
        record = await self._turns.run(
            self._stream_id, lambda: self._estimation.record(combined, options.correct, options.min_confidence)
        )
        self._fix(await self._fit(await self._lead.bind(record, replace=not self._may_be_known)))

    def _fix(self, fixed: FixedGrid) -> None:
        if not self._fixed.done():
            self._fixed.set_result(fixed)

    async def _fit(self, record: GridRecord) -> FixedGrid:
        if leaves_alone(record):
            return FixedGrid(record, None)
        options = self._config.options
        return FixedGrid(
            record, await self._turns.run(self._stream_id, lambda: self._correction.fitted(record, options))
        )

    async def _stored(self, source: StoredGrid) -> GridRecord:
        return await self._store.get(source.grid_id)

    async def _drawn(self, source: DrawnGuides) -> GridRecord:
        points = self._settings.grid_points
        grid = await self._turns.run(
            self._stream_id, lambda: self._blocking.run("grid", spin_grid, source.guides, Correct.ALL, points)
        )
        grid.check_unfolded()
        record = GridRecord(grid, source.guides)
        await self._store.put(record)
        return record
