"""Streams over fakes of the estimator and the pool."""

from __future__ import annotations

import asyncio
import dataclasses
import random
from collections import Counter
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field

import cv2
import numpy as np
import pytest

from tests.fakes import FakeEstimator, FakeRenderPool, RecordingMeter, barrel_guides
from unbend_service.adapters.codecs.pillow import PillowCodec
from unbend_service.adapters.grid_stores.memory import MemoryGridStore
from unbend_service.application.blocking import BlockingWork
from unbend_service.application.correction import Correction, CorrectOptions
from unbend_service.application.estimation import Estimation
from unbend_service.application.fitting import FittedGrids
from unbend_service.application.ports import SharedPicture
from unbend_service.application.regions import Regions
from unbend_service.application.stream_messages import (
    Delivery,
    DrawnGuides,
    EncodedFormat,
    EstimateOver,
    FrameStatus,
    GridFixed,
    RawFormat,
    StoredGrid,
    StreamConfig,
    StreamEvent,
    StreamFrame,
    StreamResult,
    WhileEstimating,
)
from unbend_service.application.streams import Streams
from unbend_service.domain.errors import (
    DeadlineExceeded,
    Draining,
    FoldedGrid,
    GridNotFound,
    InvalidFrame,
    InvalidOption,
    PoisonFrame,
    ProtocolViolation,
    QueueFull,
    RendererUnavailable,
    StreamIdle,
    StreamTakenOver,
    TooManyPixels,
    TooManyStreams,
)
from unbend_service.domain.frames import Border, Frame, PixelFormat
from unbend_service.domain.grid import Grid
from unbend_service.domain.guides import GuideFamily, Guides
from unbend_service.domain.records import GridRecord
from unbend_service.settings import Settings

WIDTH, HEIGHT = 16, 12
SMALL = RawFormat(PixelFormat.GRAY8, WIDTH, HEIGHT)
KEEP_GOING = CorrectOptions(min_confidence=0.0)


@dataclass
class UnsteadyPool(FakeRenderPool):
    """Finishes renders out of order; fails those whose first sample is a key of ``failures``, once per listed error."""

    longest_s: float = 0.01
    under_way: int = 0
    most_under_way: int = 0
    failures: dict[int, list[Exception]] = field(default_factory=dict)
    gate: asyncio.Event | None = None
    stuck: set[int] = field(default_factory=set)
    given_up: int = 0
    chance: random.Random = field(default_factory=lambda: random.Random(7))

    async def render(
        self,
        frame: Frame,
        grid: Grid,
        border: Border,
        *,
        affinity: str | None = None,
        deadline_s: float | None = None,
        shared: SharedPicture | None = None,
    ) -> np.ndarray:
        if deadline_s is not None and deadline_s <= 0:
            raise DeadlineExceeded("The deadline had passed before the frame was accepted.")
        self.under_way += 1
        self.most_under_way = max(self.most_under_way, self.under_way)
        try:
            await asyncio.sleep(self.chance.uniform(0, self.longest_s))
            if self.gate is not None:
                await self.gate.wait()
            if int(frame.data[0]) in self.stuck:
                await self._stay(deadline_s)
            if errors := self.failures.get(int(frame.data[0])):
                raise errors.pop(0)
            return await super().render(frame, grid, border, affinity=affinity, deadline_s=deadline_s, shared=shared)
        finally:
            self.under_way -= 1

    async def _stay(self, deadline_s: float | None) -> None:
        try:
            async with asyncio.timeout(deadline_s):
                await asyncio.Event().wait()
        except TimeoutError:
            raise DeadlineExceeded("The frame was not rendered in time.") from None
        except asyncio.CancelledError:
            self.given_up += 1
            raise


@dataclass
class Bench:
    """Streams of one service, and what stands behind them."""

    streams: Streams
    pool: UnsteadyPool
    estimator: FakeEstimator
    meter: RecordingMeter
    store: MemoryGridStore

    async def collect(
        self,
        config: StreamConfig,
        frames: AsyncIterator[StreamFrame],
        *,
        into: list[StreamEvent] | None = None,
        pause_s: float = 0.0,
    ) -> list[StreamEvent]:
        """Runs a stream to its end; ``into`` keeps what came before an error, ``pause_s`` makes a slow reader."""
        events = [] if into is None else into
        async with self.streams.open(config) as session:
            async for event in session.run(frames):
                events.append(event)
                await asyncio.sleep(pause_s)
        return events


Build = Callable[..., Bench]


@pytest.fixture
async def build() -> AsyncIterator[Build]:
    opened: list[BlockingWork] = []

    def make(store: MemoryGridStore | None = None, **changed: object) -> Bench:
        settings = Settings(**{"stream_estimate_wait_s": 5.0, "grid_points": 17, **changed})
        meter, estimator, pool = RecordingMeter(), FakeEstimator(), UnsteadyPool()
        blocking = BlockingWork(2, settings.queue_frames, meter)
        opened.append(blocking)
        codec, store = PillowCodec(settings), store or MemoryGridStore(settings)
        grids = FittedGrids(blocking, meter)
        estimation = Estimation(
            estimator, codec, store, grids, blocking, meter, grid_points=settings.grid_points, min_confidence=0.5
        )
        correction = Correction(estimation, codec, store, grids, pool, blocking, meter, jpeg_quality=92, deadline_s=1.0)
        regions = Regions(pool, settings.local_memory_bytes)
        streams = Streams(estimation, correction, store, codec, blocking, meter, regions, settings)
        return Bench(streams, pool, estimator, meter, store)

    yield make
    for blocking in opened:
        blocking.close()
    assert len(asyncio.all_tasks()) == 1, "a stream left a task behind"


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(20):
        while not condition():  # noqa: ASYNC110 what is waited for sets no event
            await asyncio.sleep(0.01)


def frame_of(index: int, size_bytes: int = WIDTH * HEIGHT) -> StreamFrame:
    return StreamFrame(index, index * 40_000, bytes([index % 256]) * size_bytes)


async def frames(count: int, start: int = 0, pause_s: float = 0.0) -> AsyncIterator[StreamFrame]:
    for index in range(start, start + count):
        await asyncio.sleep(pause_s)
        yield frame_of(index)


async def eventually(condition: Callable[[], bool]) -> None:
    for _ in range(1000):
        if condition():
            return
        await asyncio.sleep(0.01)
    raise AssertionError("it did not happen")


def results(events: list[StreamEvent]) -> list[StreamResult]:
    return [event for event in events if isinstance(event, StreamResult)]


def grids(events: list[StreamEvent]) -> list[GridRecord]:
    return [event.record for event in events if isinstance(event, GridFixed)]


def statuses(events: list[StreamEvent]) -> list[str]:
    return [result.status.value for result in results(events)]


async def test_every_frame_is_answered_once_and_in_order_however_the_renders_finish(build: Build) -> None:
    bench = build()

    events = await bench.collect(StreamConfig(SMALL), frames(100))

    assert [(r.index, r.timestamp_us) for r in results(events)] == [(i, i * 40_000) for i in range(100)]
    assert statuses(events) == ["corrected"] * 100
    # the frames are flat and crop shows no border, so each answer still says which frame it was
    assert [r.data[0] for r in results(events)] == list(range(100))
    assert bench.pool.most_under_way > 1


async def test_the_grid_is_estimated_once_and_said_before_the_first_result(build: Build) -> None:
    bench = build()

    events = await bench.collect(StreamConfig(SMALL, grid_source=EstimateOver(3)), frames(20))

    assert isinstance(events[0], GridFixed)
    assert len(grids(events)) == 1
    assert bench.meter.estimates == {"corrected": 1}
    assert len(bench.estimator.seen) == 3


async def test_a_resumed_stream_has_the_same_grid_without_a_second_estimate(build: Build) -> None:
    store = MemoryGridStore(Settings())
    first, replica = build(store), build(store)
    config = StreamConfig(SMALL, stream_id="camera-7")

    before = await first.collect(config, frames(10))
    async with replica.streams.open(config) as session:
        assert session.resumed
        after = [event async for event in session.run(frames(10, start=10))]

    assert grids(before)[0].id == grids(after)[0].id
    assert replica.meter.estimates == {}
    assert replica.estimator.seen == []


async def test_a_stream_that_is_opened_on_two_replicas_at_once_is_estimated_once(build: Build) -> None:
    """Whichever replica was first estimates; the other waits for its grid, and answers every frame with it."""
    store = MemoryGridStore(Settings())
    replicas = [build(store) for _ in range(3)]
    config = StreamConfig(SMALL, stream_id="camera-7")

    answers = await asyncio.gather(*(replica.collect(config, frames(30)) for replica in replicas))

    assert sum((replica.meter.estimates for replica in replicas), Counter()) == {"corrected": 1}
    assert len({grids(events)[0].id for events in answers}) == 1
    assert [statuses(events) for events in answers] == [["corrected"] * 30] * 3


async def test_a_replica_that_died_over_an_estimate_keeps_the_stream_no_longer_than_its_lease(build: Build) -> None:
    """The claim of a dead replica lapses, and the stream is estimated where it is now."""
    store = MemoryGridStore(Settings())
    assert await store.claim_stream("camera-7", "the dead one's", 0.3)
    bench = build(store)

    start = asyncio.get_running_loop().time()
    events = await bench.collect(StreamConfig(SMALL, stream_id="camera-7"), frames(10))

    assert statuses(events) == ["corrected"] * 10
    assert bench.meter.estimates == {"corrected": 1}
    assert 0.25 < asyncio.get_running_loop().time() - start < 3


async def test_a_session_that_ends_over_an_estimate_gives_its_claim_up(build: Build) -> None:
    """A client that comes back does not wait for the lease of the session that it left."""
    store = MemoryGridStore(Settings())
    bench = build(store, stream_lease_s=60.0)
    config = StreamConfig(SMALL, stream_id="camera-7")
    async with bench.streams.open(config) as session:
        waiting = asyncio.create_task(anext(session.run(frames(2, pause_s=0.2))))
        await eventually(lambda: bool(bench.estimator.seen))
        waiting.cancel()
        await asyncio.gather(waiting, return_exceptions=True)

    assert await store.claim_stream("camera-7", "the next one's", 1.0)


async def test_a_stream_may_ask_to_be_estimated_again(build: Build) -> None:
    bench = build()
    config = StreamConfig(SMALL, stream_id="camera-7")
    await bench.collect(config, frames(5))

    async with bench.streams.open(dataclasses.replace(config, estimate_again=True)) as session:
        assert not session.resumed
        _ = [event async for event in session.run(frames(5))]

    assert bench.meter.estimates == {"corrected": 2}


async def test_more_frames_to_estimate_over_than_may_be_in_flight_do_not_lock_the_stream(build: Build) -> None:
    bench = build(stream_in_flight=4)

    events = await bench.collect(StreamConfig(SMALL, grid_source=EstimateOver(64)), frames(20))

    assert statuses(events) == ["corrected"] * 20
    assert len(bench.estimator.seen) == 4


async def test_a_stream_shorter_than_the_estimate_is_corrected_too(build: Build) -> None:
    bench = build()

    events = await bench.collect(StreamConfig(SMALL, grid_source=EstimateOver(10)), frames(2))

    assert statuses(events) == ["corrected"] * 2
    assert bench.meter.estimates == {"corrected": 1}


async def test_a_client_that_waits_for_each_answer_is_not_left_waiting(build: Build) -> None:
    bench = build(stream_estimate_wait_s=0.05)
    sent: asyncio.Queue[StreamFrame] = asyncio.Queue()

    async def one_by_one() -> AsyncIterator[StreamFrame]:
        while (frame := await sent.get()).index < 3:
            yield frame

    answered = []
    async with bench.streams.open(StreamConfig(SMALL)) as session:
        sent.put_nowait(frame_of(0))
        async for event in session.run(one_by_one()):
            if isinstance(event, StreamResult):
                answered.append(event.index)
                sent.put_nowait(frame_of(event.index + 1))

    assert answered == [0, 1, 2]


async def test_a_stream_without_frames_ends(build: Build) -> None:
    bench = build()

    assert await bench.collect(StreamConfig(SMALL), frames(0)) == []


async def test_frames_pass_through_while_the_grid_is_estimated_if_asked(build: Build) -> None:
    bench = build()
    config = StreamConfig(SMALL, while_estimating=WhileEstimating.PASS_THROUGH, grid_source=EstimateOver(3))
    events: list[StreamEvent] = []

    async def until_corrected() -> AsyncIterator[StreamFrame]:
        index = 0
        while "corrected" not in statuses(events)[:-10]:
            yield frame_of(index)
            index += 1
            await asyncio.sleep(0.002)

    await bench.collect(config, until_corrected(), into=events)

    found = statuses(events)
    first = found.index("corrected")
    assert first >= 3
    assert found == ["passed_through"] * first + ["corrected"] * (len(found) - first)
    assert [r.data for r in results(events)[:first]] == [frame_of(i).data for i in range(first)]
    at = next(i for i, event in enumerate(events) if isinstance(event, GridFixed))
    assert at <= first
    assert bench.meter.frames["passed_through"] == first


async def test_a_stream_that_passed_everything_through_still_gets_its_grid(build: Build) -> None:
    bench = build()
    config = StreamConfig(SMALL, stream_id="short", while_estimating=WhileEstimating.PASS_THROUGH)

    events = await bench.collect(config, frames(2))

    assert statuses(events) == ["passed_through"] * 2
    assert await bench.store.stream_grid("short") == grids(events)[0].id


async def test_a_stream_that_is_left_alone_comes_back_as_it_was(build: Build) -> None:
    bench = build()

    events = await bench.collect(StreamConfig(SMALL, options=CorrectOptions(min_confidence=0.99)), frames(8))

    assert statuses(events) == ["passed_through"] * 8
    assert [r.data for r in results(events)] == [frame_of(i).data for i in range(8)]
    assert grids(events)[0].reason == "low_confidence"
    assert bench.meter.frames == {"left_alone": 8}


async def test_a_lossless_stream_reads_no_more_than_may_be_in_flight(build: Build) -> None:
    bench = build(stream_in_flight=3, stream_estimate_frames=1)
    read = 0

    async def counted() -> AsyncIterator[StreamFrame]:
        nonlocal read
        async for frame in frames(30):
            read += 1
            yield frame

    answered = 0
    async with bench.streams.open(StreamConfig(SMALL)) as session:
        async for event in session.run(counted()):
            if isinstance(event, StreamResult):
                await asyncio.sleep(0.01)  # a slow reader
                assert read - answered <= 3
                answered += 1
    assert answered == 30


async def test_latest_delivery_answers_the_replaced_frames_as_dropped_and_ends_with_the_newest(build: Build) -> None:
    bench = build(stream_in_flight=4, stream_estimate_frames=1)
    config = StreamConfig(SMALL, delivery=Delivery.LATEST)
    bench.pool.gate = asyncio.Event()

    async def burst() -> AsyncIterator[StreamFrame]:
        async for frame in frames(40):
            yield frame
        bench.pool.gate.set()

    events = await bench.collect(config, burst())

    found = statuses(events)
    assert [r.index for r in results(events)] == list(range(40))
    assert set(found) == {"corrected", "dropped"}
    assert found[-1] == "corrected"
    assert found.count("corrected") <= 5
    assert bench.meter.frames["dropped"] == found.count("dropped")


async def test_a_frame_of_the_wrong_size_fails_and_the_stream_goes_on(build: Build) -> None:
    bench = build()

    async def mixed() -> AsyncIterator[StreamFrame]:
        for index in range(9):
            yield frame_of(index, 5 if index % 3 == 0 else WIDTH * HEIGHT)

    events = await bench.collect(StreamConfig(SMALL), mixed())

    assert statuses(events) == ["failed", "corrected", "corrected"] * 3
    error = results(events)[0].error
    assert isinstance(error, InvalidFrame)
    assert "192 bytes, not 5" in error.message
    assert bench.meter.frames["failed"] == 3


async def test_a_stream_whose_first_frames_are_all_broken_is_estimated_over_the_first_good_ones(build: Build) -> None:
    bench = build(stream_in_flight=2, stream_estimate_frames=2)

    async def mixed() -> AsyncIterator[StreamFrame]:
        for index in range(10):
            yield frame_of(index, 1 if index < 6 else WIDTH * HEIGHT)

    events = await bench.collect(StreamConfig(SMALL), mixed())

    assert statuses(events) == ["failed"] * 6 + ["corrected"] * 4
    assert len(bench.estimator.seen) == 2


async def test_a_stream_of_broken_frames_only_ends_without_a_grid(build: Build) -> None:
    async def broken() -> AsyncIterator[StreamFrame]:
        for index in range(20):
            yield frame_of(index, 1)

    for while_estimating in WhileEstimating:
        events = await build().collect(StreamConfig(SMALL, while_estimating=while_estimating), broken())
        assert statuses(events) == ["failed"] * 20
        assert grids(events) == []


async def test_a_frame_that_is_not_drawn_within_its_deadline_fails_alone_and_in_its_turn(build: Build) -> None:
    """The pool keeps the time while it draws: it is told what is left, and nobody takes the frame from it."""
    bench = build()
    bench.pool.stuck = {2}

    async def hurried() -> AsyncIterator[StreamFrame]:
        async for frame in frames(5):
            yield dataclasses.replace(frame, deadline_s=0.05 if frame.index == 2 else 60.0)

    events = await bench.collect(StreamConfig(SMALL, grid_source=await stored(bench)), hurried())

    assert [result.index for result in results(events)] == list(range(5))
    assert statuses(events) == ["corrected", "corrected", "failed", "corrected", "corrected"]
    error = results(events)[2].error
    assert isinstance(error, DeadlineExceeded)
    assert "0.05 s that the client gave" in str(error)
    assert bench.pool.given_up == 0
    assert bench.meter.frames["failed"] == 1


async def test_a_deadline_holds_while_a_frame_waits_for_the_grid(build: Build) -> None:
    """The first frame has passed away before the others come; it was looked at all the same."""
    bench = build()
    events: list[StreamEvent] = []

    async def late() -> AsyncIterator[StreamFrame]:
        yield dataclasses.replace(frame_of(0), deadline_s=0.05)
        await eventually(lambda: bool(results(events)))
        yield frame_of(1)
        yield frame_of(2)

    await bench.collect(StreamConfig(SMALL, options=KEEP_GOING, grid_source=EstimateOver(3)), late(), into=events)

    assert statuses(events) == ["failed", "corrected", "corrected"]
    assert isinstance(results(events)[0].error, DeadlineExceeded)
    assert len(grids(events)) == 1


async def test_a_deadline_counts_from_the_reading_of_a_frame(build: Build) -> None:
    """Also where a newer one may take its place: the time that it waits for a worker is its own."""
    bench = build()
    bench.pool.gate = asyncio.Event()
    bench.pool.longest_s = 0
    config = StreamConfig(SMALL, grid_source=await stored(bench), delivery=Delivery.LATEST)

    async def hurried() -> AsyncIterator[StreamFrame]:
        for index in range(3):
            yield dataclasses.replace(frame_of(index), deadline_s=0.1 if index == 2 else None)
        await asyncio.sleep(0.2)
        bench.pool.gate.set()

    events = await bench.collect(config, hurried())

    assert statuses(events) == ["corrected", "corrected", "failed"]


async def stored(bench: Bench) -> StoredGrid:
    record = GridRecord(Grid.from_map(barrel_guides()))
    await bench.store.put(record)
    return StoredGrid(record.id)


async def test_a_frame_that_kills_workers_fails_alone(build: Build) -> None:
    bench = build()
    bench.pool.failures = {4: [PoisonFrame("Two workers died.")]}

    events = await bench.collect(StreamConfig(SMALL), frames(8))

    assert statuses(events) == ["corrected"] * 4 + ["failed"] + ["corrected"] * 3


async def test_a_full_queue_delays_a_frame_but_does_not_lose_it(build: Build) -> None:
    bench = build()
    bench.pool.failures = {i: [QueueFull("Full."), QueueFull("Full.")] for i in range(8)}

    events = await bench.collect(StreamConfig(SMALL), frames(8))

    assert statuses(events) == ["corrected"] * 8


async def test_when_nothing_can_be_rendered_any_more_the_stream_ends_so_that_it_can_be_resumed_elsewhere(
    build: Build,
) -> None:
    bench = build()
    bench.pool.failures = {3: [RendererUnavailable("No worker.")]}
    events: list[StreamEvent] = []

    with pytest.raises(RendererUnavailable):
        await bench.collect(StreamConfig(SMALL), frames(8), into=events)

    assert [result.index for result in results(events)] == [0, 1, 2]
    assert bench.streams.active == 0


async def test_an_estimator_that_fails_ends_the_stream_with_its_error(build: Build) -> None:
    for while_estimating in WhileEstimating:
        bench = build()
        bench.estimator.failure = RuntimeError("broken network")
        with pytest.raises(RuntimeError, match="broken network"):
            await bench.collect(StreamConfig(SMALL, while_estimating=while_estimating), frames(8))


async def test_an_index_that_does_not_increase_ends_the_stream_after_the_frames_before_it(build: Build) -> None:
    bench = build()
    events: list[StreamEvent] = []

    async def repeated() -> AsyncIterator[StreamFrame]:
        for index in (0, 1, 1):
            yield frame_of(index)

    with pytest.raises(ProtocolViolation, match="Frame 1 came after frame 1"):
        await bench.collect(StreamConfig(SMALL), repeated(), into=events)

    assert statuses(events) == ["corrected"] * 2


async def test_a_second_opening_of_a_stream_takes_over_and_the_older_one_is_told(build: Build) -> None:
    bench = build()
    config = StreamConfig(SMALL, stream_id="camera-7")
    open_end: asyncio.Event = asyncio.Event()

    async def endless() -> AsyncIterator[StreamFrame]:
        yield frame_of(0)
        await open_end.wait()

    older = asyncio.create_task(bench.collect(config, endless()))
    await eventually(lambda: bench.streams.active == 1)
    newer = await bench.collect(config, frames(6))

    with pytest.raises(StreamTakenOver, match="camera-7"):
        await older
    assert statuses(newer) == ["corrected"] * 6
    assert bench.streams.active == 0
    assert bench.meter.streams_open == 0


async def test_an_idle_stream_is_ended(build: Build) -> None:
    bench = build(stream_idle_s=0.05)

    async def stuck() -> AsyncIterator[StreamFrame]:
        yield frame_of(0)
        await asyncio.sleep(60)

    with pytest.raises(StreamIdle):
        await bench.collect(StreamConfig(SMALL), stuck())
    assert bench.streams.active == 0


async def test_a_reader_that_takes_no_answer_is_ended_too(build: Build) -> None:
    bench = build(stream_idle_s=0.05)

    with pytest.raises(StreamIdle):
        await bench.collect(StreamConfig(SMALL), frames(10), pause_s=60)


async def test_a_cancelled_stream_frees_everything(build: Build) -> None:
    bench = build()
    bench.pool.gate = asyncio.Event()
    task = asyncio.create_task(bench.collect(StreamConfig(SMALL), frames(50)))
    await eventually(lambda: bench.pool.under_way > 0)

    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task

    assert bench.pool.under_way == 0
    assert bench.streams.active == 0
    assert bench.meter.streams_open == 0


async def test_a_reader_that_leaves_early_frees_everything(build: Build) -> None:
    bench = build()

    async with bench.streams.open(StreamConfig(SMALL)) as session:
        async for event in session.run(frames(50)):
            if isinstance(event, StreamResult):
                break

    assert bench.streams.active == 0
    assert bench.pool.under_way == 0


async def test_draining_answers_what_was_accepted_and_then_says_so(build: Build) -> None:
    bench = build()
    events: list[StreamEvent] = []

    async def endless() -> AsyncIterator[StreamFrame]:
        async for frame in frames(5):
            yield frame
        bench.streams.drain()
        await asyncio.sleep(60)

    with pytest.raises(Draining):
        await bench.collect(StreamConfig(SMALL), endless(), into=events)
    assert statuses(events) == ["corrected"] * 5
    with pytest.raises(Draining):
        await bench.collect(StreamConfig(SMALL), frames(1))


async def test_the_number_of_streams_is_bounded(build: Build) -> None:
    bench = build(streams=1)

    async with bench.streams.open(StreamConfig(SMALL, stream_id="a")):
        with pytest.raises(TooManyStreams, match="streams") as refused:
            await bench.collect(StreamConfig(SMALL, stream_id="b"), frames(1))

    assert refused.value.setting == "streams"
    assert bench.meter.rejections == {"too_many_streams": 1}
    assert statuses(await bench.collect(StreamConfig(SMALL, stream_id="b"), frames(1))) == ["corrected"]


async def test_a_stream_may_use_a_stored_grid_or_drawn_guides(build: Build) -> None:
    bench = build()
    drawn = await bench.collect(StreamConfig(SMALL, grid_source=DrawnGuides(barrel_guides())), frames(3))
    stored = await bench.collect(StreamConfig(SMALL, grid_source=StoredGrid(grids(drawn)[0].id)), frames(3))

    assert grids(drawn)[0].id == grids(stored)[0].id
    assert statuses(drawn) == statuses(stored) == ["corrected"] * 3
    assert bench.meter.estimates == {}
    assert bench.estimator.seen == []


def folded_guides() -> Guides:
    anchors = np.array([-0.9, 0.9])
    swapped = np.zeros((2, 4))
    swapped[:, 0] = [0.5, 0.5]
    swapped[:, 1] = [0.9, -0.9]
    return Guides(GuideFamily(anchors, swapped), GuideFamily.straight(anchors, 3))


@pytest.mark.parametrize(
    ("config", "error"),
    [
        (StreamConfig(SMALL, stream_id="a b"), InvalidOption),
        (StreamConfig(SMALL, stream_id="x" * 129), InvalidOption),
        (StreamConfig(SMALL, grid_source=StoredGrid("g0")), GridNotFound),
        (StreamConfig(SMALL, grid_source=DrawnGuides(folded_guides())), FoldedGrid),
        (StreamConfig(SMALL, grid_source=EstimateOver(65)), InvalidOption),
        (StreamConfig(SMALL, options=CorrectOptions(strength=2.0)), InvalidOption),
        (StreamConfig(SMALL, options=CorrectOptions(min_confidence=-1.0)), InvalidOption),
        (StreamConfig(RawFormat(PixelFormat.I420, 0, 4)), InvalidFrame),
        (StreamConfig(RawFormat(PixelFormat.I420, 100_000, 100_000)), TooManyPixels),
    ],
)
async def test_a_stream_that_cannot_be_is_refused_when_it_is_opened(
    build: Build, config: StreamConfig, error: type[Exception]
) -> None:
    bench = build()

    with pytest.raises(error):
        await bench.collect(config, frames(1))

    assert bench.streams.active == 0


async def test_encoded_frames_come_back_encoded_and_broken_ones_fail_alone(build: Build) -> None:
    bench = build()
    picture = np.zeros((48, 64, 3), np.uint8)
    jpeg = cv2.imencode(".jpg", picture)[1].tobytes()
    png = cv2.imencode(".png", picture)[1].tobytes()

    async def mixed() -> AsyncIterator[StreamFrame]:
        for index, body in enumerate([jpeg, b"", b"text", jpeg[:100], png, jpeg]):
            yield StreamFrame(index, 0, body)

    events = await bench.collect(StreamConfig(EncodedFormat("jpeg")), mixed())

    answers = results(events)
    assert [a.status for a in answers] == [
        FrameStatus.CORRECTED,
        *[FrameStatus.FAILED] * 4,
        FrameStatus.CORRECTED,
    ]
    assert [a.error.code for a in answers if a.error] == [
        "empty_body",
        "unsupported_media_type",
        "invalid_image",
        "invalid_frame",
    ]
    assert cv2.imdecode(np.frombuffer(answers[0].data, np.uint8), cv2.IMREAD_COLOR).shape == (48, 64, 3)


async def test_frames_of_all_streams_share_one_bound_of_memory(build: Build) -> None:
    """Beyond it a stream reads its next frame when it holds none: none starves, and each frame is answered."""
    bench = build(stream_frames_bytes=1024)
    bench.pool.gate = asyncio.Event()
    large, guides = RawFormat(PixelFormat.GRAY8, 32, 32), DrawnGuides(barrel_guides())
    read: Counter[int] = Counter()

    async def frames(stream: int) -> AsyncIterator[StreamFrame]:
        for index in range(4):
            read[stream] += 1
            yield frame_of(index, 1024)

    config = StreamConfig(large, grid_source=guides)
    running = [asyncio.create_task(bench.collect(config, frames(stream))) for stream in range(3)]
    await until(lambda: bench.pool.under_way == 3)
    await asyncio.sleep(0.05)
    assert read == {0: 1, 1: 1, 2: 1}
    bench.pool.gate.set()
    for events in await asyncio.gather(*running):
        assert [e.index for e in events if isinstance(e, StreamResult)] == [0, 1, 2, 3]
    again = [asyncio.create_task(bench.collect(config, frames(9)))]
    assert len((await asyncio.gather(*again))[0]) == 5


async def test_a_stream_that_is_given_up_gives_its_memory_back(build: Build) -> None:
    """Frames that were read and never answered do not count for ever."""
    bench = build(stream_frames_bytes=1024)
    bench.pool.gate = asyncio.Event()
    config = StreamConfig(RawFormat(PixelFormat.GRAY8, 32, 32), grid_source=DrawnGuides(barrel_guides()))

    async def endless() -> AsyncIterator[StreamFrame]:
        for index in range(1000):
            yield frame_of(index, 1024)

    given_up = asyncio.create_task(bench.collect(config, endless()))
    await until(lambda: bench.pool.under_way > 0)
    given_up.cancel()
    with pytest.raises(asyncio.CancelledError):
        await given_up
    assert bench.streams.memory.used_bytes == 0
