"""One open stream: frames in, answers out, in order and each exactly once."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from dataclasses import dataclass, field

from unbend_service.application.budget import FrameMemory
from unbend_service.application.stream_frames import FrameAnswers
from unbend_service.application.stream_grid import FixedGrid, StreamGrid
from unbend_service.application.stream_messages import (
    Delivery,
    FrameStatus,
    GridFixed,
    StreamConfig,
    StreamEvent,
    StreamFrame,
    StreamResult,
)
from unbend_service.domain.errors import Draining, ProtocolViolation, StreamIdle, UnbendError

#: Answers without a picture that may wait for a slow reader before reading stops.
_DROPPED_AT_MOST = 1024


@dataclass(slots=True, eq=False)
class _Entry:
    """A frame that is not answered yet. ``answer`` is set exactly once; nobody wants it after ``end_s`` of the loop."""

    index: int
    timestamp_us: int
    answer: asyncio.Future[StreamResult]
    frame: StreamFrame | None
    end_s: float | None = None
    size_bytes: int = 0
    started: bool = False


@dataclass(slots=True, eq=False)
class StreamSession:
    """The answers of one stream; made by ``Streams.open``, which also ends it.

    Attributes:
        stream_id: to be used for resuming.
        resumed: whether the stream id was known and its grid is reused.
        ended_with: why the service ended it early, if it did.
        last_index: of the last frame whose answer was taken.
        memory: that the frames of all streams share.
    """

    stream_id: str
    config: StreamConfig
    grid: StreamGrid
    answers: FrameAnswers
    owner: asyncio.Task[object]
    memory: FrameMemory
    resumed: bool = False
    ended_with: UnbendError | None = None
    last_index: int | None = None
    _entries: asyncio.Queue[_Entry | None] = field(default_factory=asyncio.Queue)
    _tasks: set[asyncio.Task[None]] = field(default_factory=set)
    _reader: asyncio.Task[None] | None = None
    _started: int = 0
    _unanswered: int = 0
    _held_bytes: int = 0
    _waiting: _Entry | None = None
    _room: asyncio.Event = field(default_factory=asyncio.Event)
    _draining: bool = False
    _closed: bool = False
    _watchdog: asyncio.TimerHandle | None = None
    _active_at: float = 0.0

    @property
    def max_in_flight(self) -> int:
        """Frames that may be unanswered before reading stops."""
        return self.answers.settings.stream_in_flight

    async def run(self, frames: AsyncIterator[StreamFrame]) -> AsyncIterator[StreamEvent]:
        """Answers ``frames`` in their order; to be iterated once, by the task that opened the session.

        Frames are rendered side by side and answered in order. At most ``max_in_flight`` pictures are held, counted
        from their reading until the next event is asked for after their answer.

        Raises:
            ProtocolViolation: an index did not increase. Frames before it are answered first.
            Draining: the service shuts down. Frames that were accepted are answered first.
            Unavailable: nothing can be rendered any more.
        """
        self._stay_awake()
        announced = False
        if (fixed := self.grid.now()) is not None:
            announced = True
            yield GridFixed(fixed.record)
        self._reader = asyncio.create_task(self._read(frames))
        while (entry := await self._entries.get()) is not None:
            result = await entry.answer
            if not announced and (fixed := self.grid.now()) is not None:
                announced = True
                yield GridFixed(fixed.record)
            yield result
            self.last_index = entry.index
            self._touch()
            self._answered(entry)
        await self._reader
        if not announced and (fixed := await self.grid.last_chance()) is not None:
            yield GridFixed(fixed.record)
        if self._draining:
            raise Draining("The service is shutting down.", retry_after_s=0.1)

    def drain(self) -> None:
        """Reads no further frame; :meth:`run` ends after the last accepted one."""
        self._draining = True
        if self._reader is not None:
            self._reader.cancel()
        elif not self._closed:
            self.end(Draining("The service is shutting down.", retry_after_s=0.1))

    def end(self, error: UnbendError) -> None:
        """Ends the session now: its owner is cancelled, and ``Streams.open`` raises ``error`` there."""
        if self.ended_with is None and not self._closed:
            self.ended_with = error
            self.owner.cancel()

    async def close(self) -> None:
        """Ends and frees whatever is under way."""
        self._closed = True
        if self._watchdog is not None:
            self._watchdog.cancel()
        tasks = [task for task in (self._reader, *self._tasks) if task is not None]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await self.grid.close()
        self.memory.give(self._held_bytes)
        self._held_bytes = 0
        self._waiting = None
        while not self._entries.empty():
            self._entries.get_nowait()

    async def _read(self, frames: AsyncIterator[StreamFrame]) -> None:
        last = -1
        try:
            while await self._has_room():
                frame = await anext(frames, None)
                if frame is None:
                    return
                self._touch()
                if frame.index <= last:
                    raise ProtocolViolation(
                        f"Frame {frame.index} came after frame {last}.", allowed="strictly increasing indices"
                    )
                last = frame.index
                self._accept(frame)
        except asyncio.CancelledError:
            if not self._draining or self._closed:
                raise
        finally:
            self.grid.complete()
            self._entries.put_nowait(None)

    async def _has_room(self) -> bool:
        latest = self.config.delivery is Delivery.LATEST
        while self._unanswered >= (_DROPPED_AT_MOST if latest else self.max_in_flight):
            self.grid.complete()
            self._room.clear()
            await self._room.wait()
        while self.memory.full(self._held_bytes):
            self.grid.complete()
            await self.memory.changed()
        return True

    def _accept(self, frame: StreamFrame) -> None:
        loop = asyncio.get_running_loop()
        answer: asyncio.Future[StreamResult] = loop.create_future()
        end_s = None if frame.deadline_s is None else loop.time() + frame.deadline_s
        entry = _Entry(frame.index, frame.timestamp_us, answer, frame, end_s, len(frame.data))
        self._held_bytes += entry.size_bytes
        self.memory.take(entry.size_bytes)
        self._unanswered += 1
        self._entries.put_nowait(entry)
        if self.config.delivery is Delivery.LOSSLESS or self._started < self._at_once:
            self._start(entry)
            return
        self.grid.complete()
        if self._waiting is not None:
            self._drop(self._waiting)
        self._waiting = entry

    @property
    def _at_once(self) -> int:
        """Frames of a stream with latest delivery that are rendered at once: enough to keep the workers busy.

        More would only be older when they are drawn. Before the grid is fixed as many as may be held are taken, for
        the estimate.
        """
        if self.grid.now() is None:
            return self.max_in_flight
        return min(self.max_in_flight, max(2, self.answers.correction.render_workers))

    def _start(self, entry: _Entry) -> None:
        entry.started = True
        self._started += 1
        fixed = self.grid.now()
        if fixed is None:
            self.grid.expect()
        task = asyncio.create_task(self._work(entry, fixed))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def _drop(self, entry: _Entry) -> None:
        self.answers.meter.frame("dropped")
        entry.frame = None
        self._let_go(entry)
        entry.answer.set_result(StreamResult(entry.index, entry.timestamp_us, FrameStatus.DROPPED))

    def _let_go(self, entry: _Entry) -> None:
        self._held_bytes -= entry.size_bytes
        self.memory.give(entry.size_bytes)
        entry.size_bytes = 0

    def _answered(self, entry: _Entry) -> None:
        self._unanswered -= 1
        self._let_go(entry)
        self._room.set()
        if entry.started:
            self._started -= 1
        if self._waiting is not None and self._started < self._at_once:
            waiting, self._waiting = self._waiting, None
            self._start(waiting)

    async def _work(self, entry: _Entry, fixed: FixedGrid | None) -> None:
        frame, entry.frame = entry.frame, None
        assert frame is not None
        try:
            result = await self.answers.of_frame(frame, fixed, entry.end_s)
        except asyncio.CancelledError:
            entry.answer.cancel()
            raise
        except Exception as error:
            entry.answer.set_exception(error)
            entry.answer.exception()  # retrieved: the session may end before this answer's turn
        else:
            entry.answer.set_result(result)

    def _touch(self) -> None:
        self._active_at = asyncio.get_running_loop().time()

    def _stay_awake(self) -> None:
        """Ends the session once nothing has moved for ``stream_idle_s``."""
        self._touch()
        loop, idle_s = asyncio.get_running_loop(), self.answers.settings.stream_idle_s

        def look() -> None:
            left_s = self._active_at + idle_s - loop.time()
            if left_s <= 0:
                self.end(StreamIdle(f"Nothing moved for {idle_s:g} s.", setting="stream_idle_s"))
            else:
                self._watchdog = loop.call_later(left_s, look)

        self._watchdog = loop.call_later(idle_s, look)
