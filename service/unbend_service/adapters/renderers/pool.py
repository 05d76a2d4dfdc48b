"""WorkerPool: frames to worker processes and back, whatever happens to the workers."""

from __future__ import annotations

import asyncio
import math

import numpy as np
import structlog

from unbend_service.adapters.cores import usable_cores
from unbend_service.adapters.memory import check_shared_memory, memory_limit_bytes
from unbend_service.adapters.renderers.channel import Done, Failed
from unbend_service.adapters.renderers.copies import Copies
from unbend_service.adapters.renderers.jobs import Job, JobQueue, preferred_worker
from unbend_service.adapters.renderers.leases import Lending
from unbend_service.adapters.renderers.quarantine import Quarantine
from unbend_service.adapters.renderers.regions import Region, RegionKeeper
from unbend_service.adapters.renderers.selection import RendererOptions
from unbend_service.adapters.renderers.slots import SlotPool
from unbend_service.adapters.renderers.supervision import Supervisor
from unbend_service.adapters.renderers.worker_process import WorkerProcess
from unbend_service.application.ports import Bytes, Meter, PoolState, SharedMemory, SharedPicture
from unbend_service.domain.errors import (
    DeadlineExceeded,
    Draining,
    PoisonFrame,
    QueueFull,
    RendererUnavailable,
    UnbendError,
)
from unbend_service.domain.frames import Border, Frame
from unbend_service.domain.grid import Grid
from unbend_service.settings import Settings

log = structlog.get_logger(__name__)

DEFAULT_FACTORY = "unbend_service.adapters.renderers.selection:open_renderer"
#: A GPU gains little from more processes than keep it fed, and each holds a context and textures of its own.
_WORKERS_OF_A_GPU = 4
#: Two crashes make a frame poison. Who hangs may have been stopped from outside, and a SIGKILL comes from there; these
#: say less of the frame, unless they come every time.
_BLAME_OF_A_CRASH, _BLAME_OF_A_HANG, _BLAME_OF_A_KILL, _BLAME_OF_POISON = 6, 4, 3, 12
#: A frame that is alone may use so many cores, if it is worth their waking.
_MOST_THREADS, _WORTH_THREADS_BYTES = 8, 1 << 20
_METER_INTERVAL_S = 0.1
#: Memory for frames is given back once no frame came for so long.
_REST_S = 10.0


class WorkerPool:
    """Renders frames in worker processes; implements :class:`~unbend_service.application.ports.RenderPool`.

    All of it runs on one event loop. A frame waits in the queue, is copied into shared memory when a worker can take
    it, and stays there until it is answered, so a frame whose worker dies is given to another. The answer stays in
    shared memory too, lent to the caller until he lets go of it; only when answers that nobody lets go of would take
    more than half of the memory are they copied out. Cost of a frame beyond its rendering: one copy of its bytes and
    two short messages. A frame in the memory of a client is drawn there, without any copy.

    Args:
        settings: workers, slots_per_worker, shared_memory_bytes, queue_frames, render_deadline_s, hang_s, renderer,
            require_gpu, egl_device, map_cache_bytes are used.
        meter: told of restarts, stages and the pool's state.
        renderer_factory: ``module:callable`` that makes the renderer, in the worker, from RendererOptions.
    """

    def __init__(self, settings: Settings, meter: Meter, *, renderer_factory: str = DEFAULT_FACTORY) -> None:
        self._settings = settings
        self._meter = meter
        self._slots = SlotPool(settings.shared_memory_bytes)
        self._lending = Lending(self._slots, settings.shared_memory_bytes // 2, self._dispatch)
        self._queue = JobQueue()
        self._jobs: set[Job] = set()
        self._accepted = 0
        self._mean_render_s = 0.05
        self._closed = False
        self._done_all = asyncio.Event()
        self._meter_timer: asyncio.TimerHandle | None = None
        self._rest_timer: asyncio.TimerHandle | None = None
        self._copies = Copies()
        self._cores = usable_cores()
        options = RendererOptions(
            renderer=settings.renderer,
            require_gpu=settings.require_gpu,
            threads=max(1, self._cores // (settings.workers or self._cores)),
            egl_device=settings.egl_device,
            map_cache_bytes=settings.map_cache_bytes,
        )
        self._threads = options.threads
        self._quarantine = Quarantine()
        hang_s = min(settings.hang_s, settings.render_deadline_s)
        self._supervisor = Supervisor(renderer_factory, options, hang_s, self)
        self._regions = RegionKeeper(self._slots.next_number, self._supervisor.unmap)

    async def start(self) -> None:
        """Starts one worker, learns from it what the renderer is, and then starts the others.

        Raises:
            RendererUnavailable: it could not be started, a GPU is required and missing, or the memory for frames is
                more than there is.
        """
        check_shared_memory(self._settings.shared_memory_bytes, memory_limit_bytes())
        try:
            info = await self._supervisor.start_first()
        except BaseException:
            await self.close(0)
            raise
        count = self._settings.workers or (min(self._cores, _WORKERS_OF_A_GPU) if info.hardware else self._cores)
        log.info("renderer chosen", renderer=info.name, device=info.device, hardware=info.hardware, workers=count)
        self._supervisor.start_others(count)

    async def render(
        self,
        frame: Frame,
        grid: Grid,
        border: Border,
        *,
        affinity: str | None = None,
        deadline_s: float | None = None,
        shared: SharedPicture | None = None,
    ) -> Bytes:
        """See :class:`~unbend_service.application.ports.RenderPool`; ``render_deadline_s`` bounds every deadline.

        Raises:
            QueueFull, DeadlineExceeded, PoisonFrame, RenderFailed, InvalidFrame, RendererUnavailable, Draining,
            RegionNotFound.
        """
        loop = asyncio.get_running_loop()
        limit_s = min(self._settings.render_deadline_s, math.inf if deadline_s is None else deadline_s)
        self._check_accepting(limit_s)
        if self._quarantine.holds(frame, grid, border):
            self._meter.rejected(PoisonFrame.code)
            raise PoisonFrame("Workers died of this very frame a short while ago.")
        region: Region | None = None
        if shared is not None:
            region = self._regions.known(shared.memory)
            region.enter()
        self._accepted += 1
        job = Job(
            number=self._accepted,
            frame=frame,
            grid=grid,
            border=border,
            flow=affinity,
            preferred=preferred_worker(affinity, self._supervisor.count),
            accepted_s=loop.time(),
            answer=loop.create_future(),
            shared=shared,
            region=region,
            copied=shared is not None,
        )
        self._jobs.add(job)
        if self._rest_timer is not None:
            self._rest_timer.cancel()
            self._rest_timer = None
        self._queue.append(job)
        self._dispatch()
        try:
            async with asyncio.timeout_at(job.accepted_s + limit_s):
                return await job.answer
        except TimeoutError:
            if shared is not None and job not in self._queue:
                await job.released.wait()  # nobody may draw in the client's memory any more; who hangs is killed
            raise DeadlineExceeded(
                f"The frame was not rendered within {limit_s:g} s.", setting="render_deadline_s"
            ) from None
        finally:
            if self._queue.remove(job):
                self._finish(job)
                self._dispatch()
            elif job.answer.done() and not job.answer.cancelled():
                job.answer.exception()  # seen, even where the caller went in the very moment of the answer

    def adopt(self, fd: int, size_bytes: int) -> SharedMemory:
        """See :class:`~unbend_service.application.ports.RenderPool`."""
        return self._regions.adopt(fd, size_bytes)

    def disown(self, memory: SharedMemory) -> None:
        """See :class:`~unbend_service.application.ports.RenderPool`."""
        self._regions.disown(memory)

    def _check_accepting(self, limit_s: float) -> None:
        if self._closed:
            raise Draining("The renderers are shutting down.")
        if self._supervisor.count == 0 or self._supervisor.broken:
            raise RendererUnavailable(self._supervisor.reason, retry_after_s=1.0)
        if len(self._queue) >= self._settings.queue_frames:
            expected_s = len(self._queue) * self._mean_render_s / max(1, self._supervisor.count)
            self._meter.rejected(QueueFull.code)
            raise QueueFull(
                f"{len(self._queue)} frames wait for a renderer already.",
                setting="queue_frames",
                retry_after_s=round(max(0.1, expected_s), 1),
            )
        if limit_s <= 0:
            raise DeadlineExceeded("The deadline had passed before the frame was accepted.")

    def state(self) -> PoolState:
        reason = "The renderers are shutting down." if self._closed else self._supervisor.reason
        return PoolState(
            ready=not reason,
            reason=reason,
            renderer=self._supervisor.info,
            queued=len(self._queue),
            workers=self._supervisor.states(),
        )

    async def close(self, grace_s: float) -> None:
        """Finishes what was accepted, at most ``grace_s`` seconds, then ends the workers and frees shared memory."""
        self._closed = True
        try:
            async with asyncio.timeout(grace_s):
                while self._jobs and not self._supervisor.broken:
                    self._done_all.clear()
                    await self._done_all.wait()
        except TimeoutError:
            log.warning("frames given up at shutdown", frames=len(self._jobs))
        finally:
            await self._supervisor.close()
            await self._copies.close()
            self._queue = JobQueue()
            for job in self._jobs:
                job.slot = job.region = None
                job.released.set()
                _settle(job, Draining("The service shut down before the frame was rendered."))
            self._jobs.clear()
            self._slots.close()
            self._regions.close()
            for timer in (self._meter_timer, self._rest_timer):
                if timer is not None:
                    timer.cancel()
            self._meter.pool(self.state())

    def _dispatch(self) -> None:
        """Gives waiting frames to workers that can take them: first to idle ones, there to the preferred one."""
        while self._queue:
            able = [w for w in self._supervisor.ready() if len(w.held) < self._settings.slots_per_worker]
            able = [w for w in able if not w.held] or able
            if not able:
                break
            job, preferred = self._queue.pick({worker.index for worker in able}, self._supervisor.count)
            if job.slot is None:
                try:
                    job.slot = self._slots.acquire(job.slot_bytes)
                except RendererUnavailable as error:
                    self._queue.remove(job)
                    _settle(job, error)
                    self._finish(job)
                    continue
                if job.slot is None:
                    break
                if dropped := self._slots.take_dropped():
                    self._supervisor.unmap(dropped)
            self._queue.remove(job)
            chosen = next((w for w in able if w.index == preferred), None) or min(able, key=lambda w: len(w.held))
            self._assign(job, chosen)
        self._note_state()

    def on_answer(self, worker: WorkerProcess, answer: Done | Failed) -> None:
        """A worker answered the first of the jobs it knows of."""
        job = worker.sent.popleft()
        worker.held.discard(job)
        worker.rendered += 1
        if isinstance(answer, Done):
            job.context.run(self._meter.stage, "render", answer.render_s)
            self._mean_render_s += 0.1 * (answer.render_s - self._mean_render_s)
            self._copy_out(job)
        else:
            _settle(job, answer.error)
            self._finish(job)

    def on_death(self, worker: WorkerProcess, killed: bool, hung: bool) -> None:
        """A worker is gone: the frame it rendered is blamed, and all it held wait again, first in the queue."""
        culprit = worker.sent[0] if worker.sent else None
        blame = _BLAME_OF_A_KILL if killed else _BLAME_OF_A_HANG if hung else _BLAME_OF_A_CRASH
        for job in sorted(worker.held, key=lambda job: job.number, reverse=True):
            if job is culprit:
                job.blame += blame
            if job.blame >= _BLAME_OF_POISON:
                self._quarantine.add(job.frame, job.grid, job.border)
                _settle(job, PoisonFrame("Worker after worker died while it rendered this frame."))
            if not job.copied:
                continue  # the copy is under way, and what follows it sees that the worker is gone
            if job.answer.done():
                self._finish(job)
            else:
                self._queue.put_first(job)
        worker.held.clear()
        worker.sent.clear()

    def on_broken(self, reason: str) -> None:
        """No worker can be had: nobody waits in vain."""
        for job in list(self._queue):
            self._queue.remove(job)
            _settle(job, RendererUnavailable(reason, retry_after_s=1.0))
            self._finish(job)
        self._done_all.set()

    def on_restart(self, reason: str) -> None:
        self._meter.worker_restarted(reason)

    def on_change(self) -> None:
        self._dispatch()

    def _note_state(self) -> None:
        """Tells the meter what the pool looks like, soon, and not for every frame."""
        if self._meter_timer is None:
            loop = asyncio.get_running_loop()
            self._meter_timer = loop.call_later(_METER_INTERVAL_S, self._tell_state)

    def _tell_state(self) -> None:
        self._meter_timer = None
        self._meter.pool(self.state())

    def _assign(self, job: Job, worker: WorkerProcess) -> None:
        worker.held.add(job)
        if not job.copied or (job.shared is not None and not job.blame):
            job.context.run(self._meter.stage, "queue", asyncio.get_running_loop().time() - job.accepted_s)
        if job.copied:
            self._send(job, worker)
            return
        if job.slot is None:
            raise RuntimeError("a job without a slot was assigned")
        source = job.slot.memory[: job.size_bytes]

        def copied() -> None:
            job.copied = True
            if job in worker.held and not job.answer.done():
                self._send(job, worker)
                return
            worker.held.discard(job)
            if job.answer.done():
                self._finish(job)
            else:
                self._queue.put_first(job)
            self._dispatch()

        self._copies.copy(source, job.frame.data, copied)

    def _send(self, job: Job, worker: WorkerProcess) -> None:
        """Has a frame drawn that is where it has to be: with its worker's share of the cores, or all if it is alone."""
        alone = len(self._jobs) == 1 and job.size_bytes >= _WORTH_THREADS_BYTES
        job.threads = max(self._threads, min(self._cores, _MOST_THREADS)) if alone else self._threads
        self._supervisor.send(job, worker)

    def _copy_out(self, job: Job) -> None:
        if job.answer.done() or job.slot is None:
            self._finish(job)
            return
        if job.shared is not None:
            job.answer.set_result(job.shared.target)
            self._finish(job)
            return
        drawn = job.slot.memory[job.size_bytes : 2 * job.size_bytes]
        lent = self._lending.lend(job.slot, job.size_bytes, 2 * job.size_bytes)
        if lent is not None:
            job.slot = None
            job.answer.set_result(lent)
            self._finish(job)
            self._dispatch()
            return
        result = np.empty(job.size_bytes, np.uint8)

        def copied() -> None:
            if not job.answer.done():
                job.answer.set_result(result)
            self._finish(job)
            self._dispatch()

        self._copies.copy(result, drawn, copied)

    def _finish(self, job: Job) -> None:
        """The pool is done with the job; its slot is free for the next."""
        if job.slot is not None:
            self._slots.release(job.slot)
        job.slot = None
        if job.region is not None:
            self._regions.leave(job.region)
        job.region = None
        job.released.set()
        self._jobs.discard(job)
        if not self._jobs:
            self._done_all.set()
            if self._rest_timer is None and not self._closed:
                self._rest_timer = asyncio.get_running_loop().call_later(_REST_S, self._rest)

    def _rest(self) -> None:
        self._rest_timer = None
        self._slots.drop_free()
        self._supervisor.unmap(self._slots.take_dropped())


def _settle(job: Job, error: UnbendError) -> None:
    if not job.answer.done():
        job.answer.set_exception(error)
