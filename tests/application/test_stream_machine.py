"""Whatever clients do with streams, in any order: each frame answered once, in order, with its own picture."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from dataclasses import dataclass, field

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from tests.assembly import service_over_fakes
from unbend_service.application.correction import CorrectOptions
from unbend_service.application.stream_messages import (
    Delivery,
    EncodedFormat,
    EstimateOver,
    GridFixed,
    RawFormat,
    StreamConfig,
    StreamFrame,
    StreamResult,
    WhileEstimating,
)
from unbend_service.domain.errors import InvalidInput, ProtocolViolation, StreamTakenOver, UnbendError
from unbend_service.domain.frames import PixelFormat
from unbend_service.settings import Settings

WIDTH, HEIGHT = 8, 6
IDS = ("a", "b", "c")


@dataclass(eq=False)
class Connection:
    """A client of one stream: what it sent, and what came back."""

    stream_id: str
    latest: bool
    sending: asyncio.Queue[StreamFrame | None] = field(default_factory=asyncio.Queue)
    sent: list[int] = field(default_factory=list)
    answers: list[StreamResult] = field(default_factory=list)
    grids: list[str] = field(default_factory=list)
    error: UnbendError | None = None
    finished: bool = False
    violated: bool = False
    slow: bool = False
    task: asyncio.Task[None] | None = None
    opened: asyncio.Event = field(default_factory=asyncio.Event)

    async def frames(self) -> AsyncIterator[StreamFrame]:
        while (frame := await self.sending.get()) is not None:
            yield frame


class StreamMachine(RuleBasedStateMachine):
    """Opens, sends, reads, finishes, breaks and opens again; looks at every answer after each step."""

    @initialize()
    def begin(self) -> None:
        self.runner = asyncio.Runner()
        self.service = self.runner.run(self._build())
        self.live: dict[str, Connection] = {}
        self.all: list[Connection] = []
        self.grid_of: dict[str, str] = {}

    async def _build(self) -> object:
        return service_over_fakes(Settings(streams=8, stream_in_flight=4, stream_estimate_wait_s=0.01, grid_points=17))

    @rule(
        stream_id=st.sampled_from(IDS),
        delivery=st.sampled_from(Delivery),
        while_estimating=st.sampled_from(WhileEstimating),
        frames=st.sampled_from([None, 1, 3]),
        slow=st.booleans(),
    )
    def open(
        self,
        stream_id: str,
        delivery: Delivery,
        while_estimating: WhileEstimating,
        frames: int | None,
        slow: bool,
    ) -> None:
        """Opens a stream, perhaps one that is open (the older one is taken over) or was (it is resumed)."""
        older = self.live.pop(stream_id, None)
        config = StreamConfig(
            RawFormat(PixelFormat.GRAY8, WIDTH, HEIGHT),
            stream_id,
            options=CorrectOptions(min_confidence=0.0),
            grid_source=EstimateOver(frames),
            while_estimating=while_estimating,
            delivery=delivery,
        )
        connection = Connection(stream_id, delivery is Delivery.LATEST, slow=slow)
        self.live[stream_id] = connection
        self.all.append(connection)
        self._step(self._start(connection, config))
        if older is not None and not older.finished and not older.violated:
            self._step(self._ended(older))
            assert isinstance(older.error, StreamTakenOver)
            assert older.error.resume is not None
            # The answer that was just being handed over may count as not taken: better sent again than lost.
            assert older.error.resume.last_index in [None, *(answer.index for answer in older.answers)][-2:]

    @rule(wrong=st.sampled_from(["size", "id", "frames", "format"]))
    def open_wrongly(self, wrong: str) -> None:
        """A stream that cannot be is refused, and costs those that are open nothing."""
        layout = RawFormat(PixelFormat.GRAY8, 0 if wrong == "size" else WIDTH, HEIGHT)
        config = StreamConfig(
            EncodedFormat("gif") if wrong == "format" else layout,
            stream_id="no/id" if wrong == "id" else "",
            grid_source=EstimateOver(99 if wrong == "frames" else 1),
        )
        before = self.service.streams.active

        async def attempt() -> None:
            try:
                async with self.service.streams.open(config):
                    raise AssertionError("it was opened")
            except InvalidInput:
                pass

        self._step(attempt())
        assert self.service.streams.active == before

    @precondition(lambda self: self._open())
    @rule(data=st.data(), count=st.integers(1, 9), skip=st.integers(0, 3))
    def send(self, data: st.DataObject, count: int, skip: int) -> None:
        """Sends frames, with or without gaps in their indices."""
        connection = data.draw(st.sampled_from(self._open()))
        for _ in range(count):
            index = (connection.sent[-1] if connection.sent else -1) + 1 + skip
            connection.sent.append(index)
            picture = np.full(WIDTH * HEIGHT, index % 251, np.uint8).tobytes()
            connection.sending.put_nowait(StreamFrame(index, index * 1000, picture))
        self._step(asyncio.sleep(0))

    @precondition(lambda self: [c for c in self._open() if c.sent])
    @rule(data=st.data(), back=st.integers(0, 3))
    def send_again(self, data: st.DataObject, back: int) -> None:
        """A frame that was sent, or an older one: the stream ends with ProtocolViolation, after those before it."""
        connection = data.draw(st.sampled_from([c for c in self._open() if c.sent]))
        index = max(0, connection.sent[-1] - back)
        connection.sending.put_nowait(StreamFrame(index, 0, bytes(WIDTH * HEIGHT)))
        connection.violated = True
        self.live.pop(connection.stream_id)
        self._step(self._ended(connection))
        assert isinstance(connection.error, ProtocolViolation)
        assert [answer.index for answer in connection.answers] == connection.sent

    @precondition(lambda self: self._open())
    @rule(data=st.data())
    def finish(self, data: st.DataObject) -> None:
        """No more frames: every one that was sent is answered, and the stream ends well."""
        connection = data.draw(st.sampled_from(self._open()))
        connection.finished = True
        connection.sending.put_nowait(None)
        self.live.pop(connection.stream_id)
        self._step(self._ended(connection))
        assert connection.error is None
        assert [answer.index for answer in connection.answers] == connection.sent

    @precondition(lambda self: self._open())
    @rule(data=st.data())
    def vanish(self, data: st.DataObject) -> None:
        """A client is killed: its call is cancelled, and whatever it held is free."""
        connection = data.draw(st.sampled_from(self._open()))
        connection.finished = True
        self.live.pop(connection.stream_id)
        before = self.service.streams.active

        async def cancel() -> None:
            assert connection.task is not None
            connection.task.cancel()
            await asyncio.gather(connection.task, return_exceptions=True)

        self._step(cancel())
        assert self.service.streams.active == before - 1

    @rule()
    def wait(self) -> None:
        """Time passes."""
        self._step(asyncio.sleep(0.003))

    @invariant()
    def every_answer_is_the_next_one_with_its_own_picture(self) -> None:
        for connection in getattr(self, "all", []):
            indices = [answer.index for answer in connection.answers]
            assert indices == connection.sent[: len(indices)]
            for answer in connection.answers:
                assert answer.timestamp_us == answer.index * 1000
                if answer.status.value == "dropped":
                    assert connection.latest
                else:
                    assert answer.status.value in ("corrected", "passed_through")
                    assert np.frombuffer(bytes(answer.data), np.uint8)[WIDTH * HEIGHT // 2] == answer.index % 251
            assert len(connection.grids) <= 1
            for grid_id in connection.grids:
                assert self.grid_of.setdefault(connection.stream_id, grid_id) == grid_id

    def teardown(self) -> None:
        if not hasattr(self, "runner"):
            return

        async def end() -> None:
            for connection in self._open():
                connection.sending.put_nowait(None)
                await self._ended(connection)
            assert self.service.streams.active == 0
            assert self.service.meter.streams_open == 0
            await self.service.close(0)
            assert len(asyncio.all_tasks()) == 1, "a stream left a task behind"

        self.runner.run(end())
        self.runner.close()

    def _open(self) -> list[Connection]:
        return list(self.live.values())

    def _step(self, work: object) -> None:
        async def run() -> None:
            await work
            for _ in range(5):
                await asyncio.sleep(0)

        self.runner.run(run())

    async def _start(self, connection: Connection, config: StreamConfig) -> None:
        connection.task = asyncio.create_task(self._converse(connection, config))
        await asyncio.wait_for(connection.opened.wait(), 20)

    async def _converse(self, connection: Connection, config: StreamConfig) -> None:
        try:
            async with self.service.streams.open(config) as session:
                connection.opened.set()
                async for event in session.run(connection.frames()):
                    if isinstance(event, GridFixed):
                        connection.grids.append(event.record.id)
                    else:
                        connection.answers.append(event)
                    if connection.slow:
                        await asyncio.sleep(0.001)
        except UnbendError as error:
            connection.error = error

    async def _ended(self, connection: Connection) -> None:
        assert connection.task is not None
        await asyncio.wait_for(connection.task, 20)


StreamMachine.TestCase.settings = settings(
    max_examples=25, stateful_step_count=25, deadline=None, suppress_health_check=list(HealthCheck)
)
TestStreams = StreamMachine.TestCase
