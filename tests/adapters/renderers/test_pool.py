"""The pool with real worker processes. What the renderer does to each frame is told by the frame's first byte."""

from __future__ import annotations

import asyncio
import os
import signal
import time
from collections import Counter

import numpy as np
import pytest

from tests.adapters.renderers import misbehaving
from tests.adapters.renderers.conftest import MakePool, slot_descriptors, until, worker_processes
from tests.fakes import RecordingMeter
from unbend_service.adapters.renderers import supervision
from unbend_service.adapters.renderers.cpu import CpuRenderer
from unbend_service.adapters.renderers.pool import WorkerPool
from unbend_service.domain.errors import (
    DeadlineExceeded,
    Draining,
    InvalidFrame,
    PoisonFrame,
    QueueFull,
    RendererUnavailable,
    RenderFailed,
)
from unbend_service.domain.frames import BLACK, Bytes, Frame, PixelFormat, frame_size_bytes
from unbend_service.domain.grid import Grid
from unbend_service.settings import Settings

GRID = Grid.from_map(lambda p: p * (1.1 - 0.1 * (p**2).sum(axis=-1, keepdims=True)))


def frame(order: int, seed: int = 0, width: int = 640, height: int = 360) -> Frame:
    data = np.random.default_rng(seed).integers(0, 256, frame_size_bytes(PixelFormat.I420, width, height), np.uint8)
    data[0] = order
    return Frame(PixelFormat.I420, width, height, data)


def expected(source: Frame, grid: Grid = GRID) -> Bytes:
    target = np.empty_like(source.data)
    CpuRenderer().render(source, grid, BLACK, target)
    return target


async def who(pool: WorkerPool, affinity: str | None = None) -> int:
    """Number of the process that rendered."""
    answer = await pool.render(frame(misbehaving.WHO, width=64), GRID, BLACK, affinity=affinity)
    return int.from_bytes(answer[:4].tobytes())


async def test_frames_of_all_sizes_and_grids_come_back_rendered(make_pool: MakePool, meter: RecordingMeter) -> None:
    """What the pool answers is what the renderer draws, for every frame of many at once."""
    pool = await make_pool(workers=2)
    grids = [GRID, Grid.identity(3, 4), Grid.from_map(lambda p: p[..., ::-1] * 0.9)]
    frames = [frame(misbehaving.DRAW, n, 16 + 60 * (n % 9), 9 + 31 * (n % 7)) for n in range(40)]
    answers = await asyncio.gather(*(pool.render(f, grids[n % 3], BLACK) for n, f in enumerate(frames)))
    for n, (source, answer) in enumerate(zip(frames, answers, strict=True)):
        np.testing.assert_array_equal(answer, expected(source, grids[n % 3]))
        assert answer.flags.owndata
    assert meter.stages == {"queue": 40, "render": 40}
    assert meter.restarts == {}


async def test_a_frame_that_is_alone_has_every_core(make_pool: MakePool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A large picture does not wait for one core while the others rest; frames side by side share them."""
    monkeypatch.setattr("unbend_service.adapters.renderers.pool.usable_cores", lambda: 2)
    pool = await make_pool(workers=2)
    large, small = frame(misbehaving.THREADS, width=1280, height=720), frame(misbehaving.THREADS)

    async def threads(source: Frame) -> int:
        return int((await pool.render(source, GRID, BLACK))[0])

    assert [await threads(large), await threads(small), await threads(large)] == [2, 1, 2]
    together = await asyncio.gather(*(threads(large) for _ in range(4)))
    assert together.count(1) >= 3  # the last may be alone when it is its turn


async def test_a_killed_worker_loses_no_frame(make_pool: MakePool, meter: RecordingMeter) -> None:
    """kill -9 in the middle of the work: every frame arrives, right and once, and the worker is replaced."""
    pool = await make_pool(workers=2)
    before = {worker.pid for worker in pool.state().workers}
    frames = [frame(misbehaving.DRAW, n) for n in range(40)]
    answers = [asyncio.create_task(pool.render(f, GRID, BLACK, affinity=str(n % 3))) for n, f in enumerate(frames)]
    for pid in before:
        done = meter.stages["render"]
        await until(lambda done=done: meter.stages["render"] >= done + 8)
        assert pid is not None
        os.kill(pid, signal.SIGKILL)
    for source, answer in zip(frames, await asyncio.gather(*answers), strict=True):
        np.testing.assert_array_equal(answer, expected(source))
    await until(lambda: all(worker.state == "ready" for worker in pool.state().workers))
    assert before.isdisjoint(worker.pid for worker in pool.state().workers)
    assert meter.restarts["died"] == 2


async def test_a_frame_is_rendered_again_when_its_worker_is_killed(make_pool: MakePool, meter: RecordingMeter) -> None:
    """The caller notices nothing of workers that were killed while they had the frame, not even of two."""
    pool = await make_pool()
    source = frame(misbehaving.KILLED_TWICE)
    np.testing.assert_array_equal(await pool.render(source, GRID, BLACK), expected(source))
    assert meter.restarts == {"died": 2}
    assert pool.state().workers[0].restarts == 2


@pytest.mark.parametrize(("order", "deaths"), [(misbehaving.CRASH, 2), (misbehaving.KILLED, 4)])
async def test_a_frame_in_which_workers_die_is_given_up(
    make_pool: MakePool, meter: RecordingMeter, order: int, deaths: int
) -> None:
    """A poisonous frame is answered with PoisonFrame; those behind it in the same worker are not blamed."""
    pool = await make_pool(slots_per_worker=3)
    await pool.render(frame(misbehaving.DRAW), GRID, BLACK)
    poison = asyncio.create_task(pool.render(frame(order), GRID, BLACK))
    behind = [asyncio.create_task(pool.render(frame(misbehaving.DRAW, n), GRID, BLACK)) for n in range(4)]
    with pytest.raises(PoisonFrame):
        await poison
    for n, answer in enumerate(behind):
        np.testing.assert_array_equal(await answer, expected(frame(misbehaving.DRAW, n)))
    assert meter.restarts == {"died": deaths}


async def test_an_affinity_keeps_to_one_worker_while_that_is_free(make_pool: MakePool) -> None:
    """A stream finds its maps warm: frame after frame goes to the same worker, and streams spread over workers."""
    pool = await make_pool(workers=2)
    workers = {key: {await who(pool, key) for _ in range(4)} for key in "abcdefgh"}
    assert all(len(pids) == 1 for pids in workers.values())
    assert len(set.union(*workers.values())) == 2


async def test_no_worker_idles_while_a_frame_waits(make_pool: MakePool) -> None:
    """Affinity is a preference only: frames of one stream that come at once are rendered by all workers."""
    pool = await make_pool(workers=2)
    shares = Counter(await asyncio.gather(*(who(pool, "stream") for _ in range(20))))
    assert len(shares) == 2
    assert min(shares.values()) >= 4


async def test_a_full_queue_refuses_at_once(make_pool: MakePool, meter: RecordingMeter) -> None:
    """One frame too many is refused with the setting's name and when to come back; the accepted ones are rendered."""
    pool = await make_pool(queue_frames=2, slots_per_worker=1)
    accepted = [asyncio.create_task(pool.render(frame(misbehaving.SLEEP), GRID, BLACK)) for _ in range(3)]
    await asyncio.sleep(0)
    assert pool.state().queued == 2
    with pytest.raises(QueueFull, match="queue_frames") as refusal:
        await pool.render(frame(misbehaving.DRAW), GRID, BLACK)
    assert refusal.value.retry_after_s is not None
    assert refusal.value.retry_after_s > 0
    assert meter.rejections == {"queue_full": 1}
    assert len(await asyncio.gather(*accepted)) == 3


async def test_a_frame_that_waits_too_long_is_given_up(make_pool: MakePool) -> None:
    """The deadline holds in the queue, and the frame leaves it."""
    pool = await make_pool(slots_per_worker=1)
    slow = asyncio.create_task(pool.render(frame(misbehaving.SLEEP), GRID, BLACK))
    await asyncio.sleep(0)
    with pytest.raises(DeadlineExceeded):
        await pool.render(frame(misbehaving.DRAW), GRID, BLACK, deadline_s=0.05)
    assert pool.state().queued == 0
    await slow
    with pytest.raises(DeadlineExceeded):
        await pool.render(frame(misbehaving.DRAW), GRID, BLACK, deadline_s=0)


async def test_a_short_deadline_kills_no_worker(make_pool: MakePool, meter: RecordingMeter) -> None:
    """An impatient caller is answered in time, and the worker that is still at it lives on."""
    pool = await make_pool()
    pid = pool.state().workers[0].pid
    started = time.monotonic()
    with pytest.raises(DeadlineExceeded):
        await pool.render(frame(misbehaving.SLEEP), GRID, BLACK, deadline_s=0.05)
    assert time.monotonic() - started < misbehaving.SLEEP_S
    await pool.render(frame(misbehaving.DRAW), GRID, BLACK)
    assert pool.state().workers[0].pid == pid
    assert meter.restarts == {}


async def test_a_hung_worker_is_replaced(make_pool: MakePool, meter: RecordingMeter) -> None:
    """The caller of the frame that hangs gets DeadlineExceeded; the pool renders on."""
    pool = await make_pool(render_deadline_s=1.0)
    with pytest.raises(DeadlineExceeded):
        await pool.render(frame(misbehaving.HANG), GRID, BLACK)
    await until(lambda: meter.restarts["hung"] == 1)
    await until(lambda: pool.state().ready)
    await pool.render(frame(misbehaving.DRAW), GRID, BLACK)


async def test_a_stopped_worker_is_replaced(make_pool: MakePool, meter: RecordingMeter) -> None:
    """A process that the system froze counts as hung."""
    pool = await make_pool(render_deadline_s=1.0)
    pid = pool.state().workers[0].pid
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    with pytest.raises(DeadlineExceeded):
        await pool.render(frame(misbehaving.DRAW), GRID, BLACK)
    await until(lambda: meter.restarts["hung"] == 1 and pool.state().ready)


async def test_a_frame_whose_worker_is_stopped_is_rendered_by_the_next(
    make_pool: MakePool, meter: RecordingMeter
) -> None:
    """SIGSTOP in the middle of a frame, and again at the next worker: after hang_s each is replaced, and the caller
    gets his picture."""
    pool = await make_pool(hang_s=0.5)
    stopped = pool.state().workers[0].pid
    source = frame(misbehaving.STOPPED_TWICE)
    np.testing.assert_array_equal(await pool.render(source, GRID, BLACK), expected(source))
    assert meter.restarts == {"hung": 2}
    assert stopped not in {process.pid for process in worker_processes()}


async def test_a_worker_that_hangs_has_a_deputy_by_then(make_pool: MakePool, meter: RecordingMeter) -> None:
    """Nobody waits for the start of a process after the deadline of the one that hung: another stands by."""
    pool = await make_pool(hang_s=4.0)
    hanging = pool.state().workers[0].pid
    source = frame(misbehaving.STOPPED_ONCE)
    rendering = asyncio.create_task(pool.render(source, GRID, BLACK))
    await until(lambda: len(worker_processes()) == 2)
    assert pool.state().workers[0].pid == hanging
    (deputy,) = (process for process in worker_processes() if process.pid != hanging)
    await until(lambda: deputy.name() == "unbend-deputy0")
    np.testing.assert_array_equal(await rendering, expected(source))
    assert pool.state().workers[0].pid == deputy.pid
    await until(lambda: deputy.name() == "unbend-render0")
    assert meter.restarts == {"hung": 1}


async def test_a_deputy_goes_when_the_frame_comes_after_all(
    make_pool: MakePool, meter: RecordingMeter, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A frame that takes long costs a process for a while, and no worker."""
    monkeypatch.setattr(supervision, "_DEPUTY_STAYS_S", 0.1)
    pool = await make_pool(hang_s=6.0)
    slow = pool.state().workers[0].pid
    assert slow is not None
    rendering = asyncio.create_task(pool.render(frame(misbehaving.STOPPED_ONCE), GRID, BLACK))
    await until(lambda: len(worker_processes()) == 2)
    os.kill(slow, signal.SIGCONT)
    await rendering
    await until(lambda: [process.pid for process in worker_processes()] == [slow])
    assert not meter.restarts


async def test_a_frame_that_hangs_three_workers_is_poison(make_pool: MakePool, meter: RecordingMeter) -> None:
    """A frame that no worker gets done with is given up before its deadline."""
    pool = await make_pool(hang_s=0.5)
    with pytest.raises(PoisonFrame):
        await pool.render(frame(misbehaving.HANG), GRID, BLACK)
    assert meter.restarts == {"hung": 3}


async def test_a_poisonous_frame_is_kept_out(make_pool: MakePool, meter: RecordingMeter) -> None:
    """Sent again, it is refused at once and costs no further worker; frames like it are rendered."""
    pool = await make_pool()
    for _ in range(3):
        with pytest.raises(PoisonFrame):
            await pool.render(frame(misbehaving.CRASH), GRID, BLACK)
    assert meter.restarts == {"died": 2}
    assert meter.rejections == {"poison_frame": 2}
    with pytest.raises(PoisonFrame, match="worker died"):
        await pool.render(frame(misbehaving.CRASH, seed=1), GRID, BLACK)


async def test_a_renderer_that_is_lost_costs_no_frame(make_pool: MakePool, meter: RecordingMeter) -> None:
    """A worker whose OpenGL context is gone says so and is replaced, and the frame is drawn by the next."""
    pool = await make_pool()
    source = frame(misbehaving.LOST_ONCE)
    np.testing.assert_array_equal(await pool.render(source, GRID, BLACK), expected(source))
    assert meter.restarts == {"renderer_lost": 1}
    with pytest.raises(PoisonFrame):
        await pool.render(frame(misbehaving.LOST), GRID, BLACK)


async def test_many_crashes_within_a_minute_make_the_pool_unready(make_pool: MakePool, meter: RecordingMeter) -> None:
    """The fifth crash of a minute flips readiness, with the reason; frames that come all the same are rendered."""
    pool = await make_pool()
    for seed in range(2):
        with pytest.raises(PoisonFrame):
            await pool.render(frame(misbehaving.CRASH, seed), GRID, BLACK)
    await until(lambda: pool.state().ready)
    with pytest.raises(PoisonFrame):
        await pool.render(frame(misbehaving.CRASH, 2), GRID, BLACK)
    await until(lambda: pool.state().workers[0].state == "ready")
    state = pool.state()
    assert not state.ready
    assert state.reason == "6 render workers died within 60 s, the last one: died, exit status 70."
    np.testing.assert_array_equal(
        await pool.render(frame(misbehaving.DRAW), GRID, BLACK), expected(frame(misbehaving.DRAW))
    )


async def test_workers_killed_from_outside_are_no_storm(make_pool: MakePool, meter: RecordingMeter) -> None:
    """Whoever kills sound workers one after the other does not take the service off the net."""
    pool = await make_pool()
    for kills in range(1, 7):
        await pool.render(frame(misbehaving.DRAW), GRID, BLACK)
        os.kill(pool.state().workers[0].pid or 0, signal.SIGKILL)
        await until(lambda kills=kills: meter.restarts["died"] == kills and pool.state().ready)
    assert pool.state().ready


async def test_more_memory_for_frames_than_there_is_is_refused_at_start(make_pool: MakePool) -> None:
    """The error names the setting and what would be allowed, before any worker is started."""
    with pytest.raises(RendererUnavailable, match=r"Allowed: up to \d+ bytes.*Setting: shared_memory_bytes"):
        await make_pool(shared_memory_bytes=1 << 50)
    assert worker_processes() == []


async def test_cancelling_frees_queue_and_slots(make_pool: MakePool) -> None:
    """A caller who goes takes the frame along: out of the queue at once, out of the slot when the worker is done."""
    pool = await make_pool(slots_per_worker=1, shared_memory_bytes=1 << 20)
    tasks = [asyncio.create_task(pool.render(frame(misbehaving.SLEEP), GRID, BLACK)) for _ in range(3)]
    await asyncio.sleep(0.1)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    assert all(task.cancelled() for task in tasks)
    assert pool.state().queued == 0
    await until(lambda: pool.state().workers[0].state == "ready")
    # the bound holds one such frame only, so this one shows that the slot came back
    await pool.render(frame(misbehaving.DRAW), GRID, BLACK, deadline_s=5)


async def test_memory_is_bounded_and_its_setting_named(make_pool: MakePool) -> None:
    """Frames wait for shared memory; one that can never fit is refused with the name of the setting."""
    pool = await make_pool(workers=2, shared_memory_bytes=1 << 20)
    sizes = [(640, 360), (320, 180), (640, 360), (500, 300)] * 4
    answers = await asyncio.gather(
        *(pool.render(frame(misbehaving.DRAW, n, *size), GRID, BLACK) for n, size in enumerate(sizes))
    )
    for n, size in enumerate(sizes):
        np.testing.assert_array_equal(answers[n], expected(frame(misbehaving.DRAW, n, *size)))
    assert slot_descriptors() <= 8
    with pytest.raises(RendererUnavailable, match="shared_memory_bytes"):
        await pool.render(frame(misbehaving.DRAW, 0, 1920, 1080), GRID, BLACK)


async def test_a_pool_at_rest_holds_no_memory_for_frames(make_pool: MakePool, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a burst needed goes back to the system once it is over, and comes again with the next."""
    monkeypatch.setattr("unbend_service.adapters.renderers.pool._REST_S", 0.05)
    pool = await make_pool()
    for _ in range(2):
        await asyncio.gather(*(pool.render(frame(misbehaving.DRAW, n), GRID, BLACK) for n in range(4)))
        await until(lambda: slot_descriptors() == 0)


async def test_a_renderer_that_fails_is_an_error_and_then_replaced(make_pool: MakePool, meter: RecordingMeter) -> None:
    """One failure is the frame's error; failures in a row are the worker's, and it is replaced."""
    pool = await make_pool()
    for _ in range(3):
        with pytest.raises(RenderFailed, match="a renderer that fails"):
            await pool.render(frame(misbehaving.RAISE), GRID, BLACK)
    await until(lambda: meter.restarts["died"] == 1)
    await pool.render(frame(misbehaving.DRAW), GRID, BLACK)


async def test_errors_of_the_renderer_keep_their_type(make_pool: MakePool) -> None:
    """What the renderer says of a frame reaches the caller as it was said."""
    pool = await make_pool()
    with pytest.raises(InvalidFrame) as refusal:
        await pool.render(Frame(PixelFormat.GRAY8, 40_000, 1, np.zeros(40_000, np.uint8)), GRID, BLACK)
    assert refusal.value.allowed == "1 to 32766 pixels on a side"


async def test_a_pool_without_a_renderer_does_not_start(make_pool: MakePool) -> None:
    """The reason that the worker gives is the error of start, and nothing is left running."""
    with pytest.raises(RendererUnavailable, match=r"nothing to render with\. Setting: renderer\."):
        await make_pool("open_nothing")
    assert worker_processes() == []


async def test_workers_that_die_at_start_are_not_tried_forever(make_pool: MakePool) -> None:
    """start gives up after a few deaths."""
    with pytest.raises(RendererUnavailable, match="die at start: exit status 3"):
        await make_pool("die_at_start")


async def test_a_storm_of_deaths_makes_the_pool_unready(make_pool: MakePool, meter: RecordingMeter) -> None:
    """When no worker can be had any more, state says so and why, and callers are told instead of waiting."""
    pool = await make_pool("die_at_restart")
    waiting = asyncio.create_task(pool.render(frame(misbehaving.CRASH), GRID, BLACK))
    with pytest.raises(RendererUnavailable, match="died at start"):
        await waiting
    state = pool.state()
    assert not state.ready
    assert "died at start: exit status 3" in state.reason
    with pytest.raises(RendererUnavailable):
        await pool.render(frame(misbehaving.DRAW), GRID, BLACK)
    assert meter.restarts["start_failed"] >= 2


async def test_closing_finishes_what_was_accepted(make_pool: MakePool) -> None:
    """Within the grace every accepted frame is answered, new ones are refused, and then everything is gone."""
    pool = await make_pool(slots_per_worker=1)
    accepted = [asyncio.create_task(pool.render(frame(misbehaving.SLEEP), GRID, BLACK)) for _ in range(2)]
    await asyncio.sleep(0)
    closing = asyncio.create_task(pool.close(10))
    await asyncio.sleep(0)
    with pytest.raises(Draining):
        await pool.render(frame(misbehaving.DRAW), GRID, BLACK)
    assert pool.state().reason
    for answer in await asyncio.gather(*accepted):
        np.testing.assert_array_equal(answer, expected(frame(misbehaving.SLEEP)))
    await closing
    assert worker_processes() == []
    accepted.clear()
    del answer  # until then it lies in shared memory
    assert slot_descriptors() == 0


async def test_closing_without_grace_answers_with_draining(make_pool: MakePool) -> None:
    """Nobody waits for ever on a pool that is gone, not even on a worker that hangs."""
    pool = await make_pool(slots_per_worker=1)
    tasks = [asyncio.create_task(pool.render(frame(misbehaving.HANG), GRID, BLACK)) for _ in range(2)]
    await asyncio.sleep(0.1)
    await pool.close(0.1)
    for task in tasks:
        with pytest.raises(Draining):
            await task
    await pool.close(0)


async def test_the_meter_sees_the_pool(make_pool: MakePool, meter: RecordingMeter) -> None:
    """Metrics show renderer, queue and workers as state does, soon after they change."""
    pool = await make_pool()
    await until(lambda: bool(meter.pools) and meter.pools[-1].ready)
    told = meter.pools[-1]
    assert told.renderer == pool.state().renderer
    assert [worker.state for worker in told.workers] == ["ready"]


async def test_the_real_renderer_is_chosen_by_the_settings(meter: RecordingMeter) -> None:
    """Without further ado the pool runs the renderer that the settings name, and says which."""
    pool = WorkerPool(Settings(renderer="cpu", workers=1), meter)
    assert not pool.state().ready
    with pytest.raises(RendererUnavailable, match="not started"):
        await pool.render(frame(misbehaving.DRAW), GRID, BLACK)
    await pool.start()
    info = pool.state().renderer
    assert info is not None
    assert (info.name, info.hardware) == ("cpu", False)
    source = frame(misbehaving.DRAW)
    np.testing.assert_array_equal(await pool.render(source, GRID, BLACK), expected(source))
    await pool.close(1)


async def test_a_required_gpu_that_is_missing_stops_the_start(meter: RecordingMeter) -> None:
    """require_gpu never falls back to the processor."""
    pool = WorkerPool(Settings(renderer="cpu", require_gpu=True, workers=1), meter)
    with pytest.raises(RendererUnavailable, match="GPU is required"):
        await pool.start()
    assert worker_processes() == []


async def test_closing_during_the_start_ends_it(meter: RecordingMeter) -> None:
    """Who stops a service that is still starting does not wait for it."""
    pool = WorkerPool(Settings(renderer="cpu", workers=1), meter)
    starting = asyncio.create_task(pool.start())
    await until(lambda: bool(worker_processes()))
    await pool.close(5)
    with pytest.raises(RendererUnavailable, match="shut down"):
        await starting
    assert worker_processes() == []
