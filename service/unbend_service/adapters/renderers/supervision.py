"""Supervisor: keeps the worker processes alive, and tells the pool what they say."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Iterable
from contextlib import suppress
from typing import Protocol

import structlog

from unbend_service.adapters.renderers.channel import Done, Failed, Ready
from unbend_service.adapters.renderers.jobs import Job
from unbend_service.adapters.renderers.places import Place
from unbend_service.adapters.renderers.selection import RendererOptions
from unbend_service.adapters.renderers.storms import StormGuard
from unbend_service.adapters.renderers.worker_process import WorkerProcess
from unbend_service.application.ports import RendererInfo, WorkerState
from unbend_service.domain.errors import RendererUnavailable

log = structlog.get_logger(__name__)

_START_TIMEOUT_S = 60.0
#: A worker that lived so long, or was given a frame, was in order: its successor starts at once.
_SOUND_LIFE_S = 2.0
#: After this share of what a frame may take a deputy is started: should it hang, nobody waits for the start of another.
_SUSPECT = 0.15
#: A deputy that was not needed stays for so long: where one frame is late others will be, and each start costs.
_DEPUTY_STAYS_S = 30.0
_FAILURES_TO_GIVE_UP = 3
_LONGEST_BACKOFF_S = 30.0
_LAST_WORDS_S = 2.0
#: Why a worker was killed that rendered one frame for too long.
HUNG = "hung"
#: The channel of a dying process closes a moment before its exit status is there.
_LAST_BREATH_S = 0.05


class Listener(Protocol):
    """Who is told what happens to the workers."""

    def on_answer(self, worker: WorkerProcess, answer: Done | Failed) -> None: ...

    def on_death(self, worker: WorkerProcess, killed: bool, hung: bool) -> None:
        """``killed``: from outside or for lack of memory, not by a fault of its own. ``hung``: killed here, as it
        rendered one frame for longer than ``hang_s``."""
        ...

    def on_restart(self, reason: str) -> None: ...

    def on_broken(self, reason: str) -> None: ...

    def on_change(self) -> None:
        """Some worker can take a frame now, or no longer."""
        ...


class Supervisor:
    """Starts workers, watches them, and starts others in place of those that die or hang.

    Args:
        hang_s: a worker that renders one frame for longer is killed.
    """

    def __init__(self, factory: str, options: RendererOptions, hang_s: float, listener: Listener) -> None:
        self._factory = factory
        self._options = options
        self._hang_s = hang_s
        self._listener = listener
        self._places: list[Place] = []
        self._first: asyncio.Future[RendererInfo] | None = None
        self._reaping: set[asyncio.Task[int]] = set()
        self._storm = StormGuard()
        self._last_error = ""
        self._closed = False
        self.info: RendererInfo | None = None

    @property
    def count(self) -> int:
        """Workers that there should be."""
        return len(self._places)

    @property
    def broken(self) -> bool:
        """Whether workers died at start so often that nobody should wait for one."""
        return bool(self._places) and all(
            place.failures >= _FAILURES_TO_GIVE_UP and (place.worker is None or place.worker.info is None)
            for place in self._places
        )

    @property
    def reason(self) -> str:
        """Why frames had better not be sent here, in one sentence; empty if they can be.

        In a storm that is so although some worker may live: whoever sends a frame all the same may be lucky.
        """
        if self.ready():
            return self._storm.reason(asyncio.get_running_loop().time())
        if not self._places:
            return "The renderers were not started."
        if self.broken:
            return f"Every render worker died at start: {self._last_error}"
        return "The render workers are starting."

    def ready(self) -> list[WorkerProcess]:
        """Workers that have their renderer."""
        workers = (place.worker for place in self._places)
        return [worker for worker in workers if worker is not None and worker.info is not None]

    def states(self) -> list[WorkerState]:
        return [place.state() for place in self._places]

    async def start_first(self) -> RendererInfo:
        """Starts one worker and returns what its renderer is.

        Raises:
            RendererUnavailable: it said that it cannot have one, or died again and again.
        """
        self._first = asyncio.get_running_loop().create_future()
        self._places.append(Place(0))
        self._launch(self._places[0])
        return await self._first

    def start_others(self, count: int) -> None:
        """Starts as many as are missing to ``count``."""
        for index in range(len(self._places), count):
            self._places.append(Place(index))
            self._launch(self._places[index])

    def send(self, job: Job, worker: WorkerProcess) -> None:
        """Gives the worker a job that it holds; if the worker is gone, its death will be told."""
        try:
            worker.begin(job)
        except OSError:
            worker.kill()
            return
        if len(worker.sent) == 1:
            self._watch_frame(self._places[worker.index])

    def unmap(self, slots: Iterable[int]) -> None:
        """Tells every worker that slots are gone."""
        slots = tuple(slots)
        for worker in self.ready():
            try:
                worker.unmap(slots)
            except OSError:
                worker.kill()

    async def close(self) -> None:
        """Ends every worker: an idle one by itself, one at work by force."""
        self._closed = True
        if self._first is not None and not self._first.done():
            self._first.set_exception(RendererUnavailable("The renderers were shut down before they had started."))
        for place in self._places:
            place.stop_timer()
            self._dismiss(place)
            if place.worker is not None:
                self._release(place.worker)
                if place.worker.sent or place.worker.info is None:
                    place.worker.kill()
                place.worker = None
        if self._reaping:
            await asyncio.wait(self._reaping)

    def _launch(self, place: Place) -> None:
        place.timer = None
        place.verdict = ""
        place.keep_deputy()
        try:
            if place.deputy is not None:
                place.deputy.take_over()
            place.worker, place.deputy = place.deputy or self._started(place), None
        except OSError as error:
            self._last_error = f"{type(error).__name__}: {error}"
            self._storm.note(asyncio.get_running_loop().time(), self._last_error)
            self._retry(place, "start_failed")
            return
        if place.worker.info is None:
            self._watch(place, _START_TIMEOUT_S, "start_timeout")
        else:
            self._on_ready(place, place.worker, place.worker.info)
        self._listener.on_change()

    def _started(self, place: Place, *, deputy: bool = False) -> WorkerProcess:
        loop = asyncio.get_running_loop()
        worker = WorkerProcess(place.index, self._factory, self._options, loop.time(), deputy=deputy)
        loop.add_reader(worker.channel.fileno(), self._read, place, worker)
        return worker

    def _suspect(self, place: Place) -> None:
        place.keep_deputy()
        if place.deputy is None:
            log.info("frame takes long: another worker is started", worker=place.index)
            with suppress(OSError):  # it will be tried again when it is needed
                place.deputy = self._started(place, deputy=True)

    def _dismiss_later(self, place: Place) -> None:
        """The deputy was not needed this time."""
        if place.deputy is not None and place.dismissal is None:
            loop = asyncio.get_running_loop()
            place.dismissal = loop.call_later(_DEPUTY_STAYS_S, self._dismiss, place)

    def _dismiss(self, place: Place) -> None:
        """The deputy is not needed, or of no use."""
        place.keep_deputy()
        if place.deputy is not None:
            deputy, place.deputy = place.deputy, None
            deputy.kill()
            self._release(deputy)

    def _read(self, place: Place, worker: WorkerProcess) -> None:
        while worker in (place.worker, place.deputy):
            try:
                message = worker.receive()
            except BlockingIOError:
                break
            except EOFError:
                if worker is place.deputy:
                    self._dismiss(place)
                else:
                    self._bury(place, worker)
                break
            if worker is place.deputy:
                if isinstance(message, Ready):
                    worker.info = message.info
                    log.info("another worker stands by", worker=place.index, pid=worker.pid)
                else:
                    self._dismiss(place)
                continue
            if isinstance(message, Ready):
                self._on_ready(place, worker, message.info)
            elif isinstance(message, Failed) and message.task is None:
                worker.refused = True
                self._on_refusal(message)
                if worker.info is not None:
                    place.verdict = "renderer_lost"
                    worker.kill()
            else:
                self._listener.on_answer(worker, message)
                place.stop_timer()
                self._dismiss_later(place)
                if worker.sent:
                    self._watch_frame(place)
        self._listener.on_change()

    def _on_ready(self, place: Place, worker: WorkerProcess, info: RendererInfo) -> None:
        place.stop_timer()
        worker.info = self.info = info
        log.info("render worker ready", worker=place.index, pid=worker.pid, renderer=info.name, device=info.device)
        if self._first is not None and not self._first.done():
            self._first.set_result(info)

    def _on_refusal(self, refusal: Failed) -> None:
        """The worker said itself why it cannot start, or go on; trying again at once would not help the first."""
        self._last_error = str(refusal.error)
        if self._first is not None and not self._first.done():
            self._first.set_exception(refusal.error)

    def _watch_frame(self, place: Place) -> None:
        self._watch(place, self._hang_s, HUNG)
        loop = asyncio.get_running_loop()
        place.suspicion = loop.call_later(_SUSPECT * self._hang_s, self._suspect, place)

    def _watch(self, place: Place, limit_s: float, verdict: str) -> None:
        def condemn() -> None:
            if place.worker is not None:
                place.verdict = verdict
                place.worker.kill()

        place.stop_timer()
        place.timer = asyncio.get_running_loop().call_later(limit_s, condemn)

    def _bury(self, place: Place, worker: WorkerProcess) -> None:
        place.worker = None
        place.stop_timer()
        status = worker.exit_status(_LAST_BREATH_S)
        worker.kill()
        self._release(worker)
        ready = worker.info is not None
        reason = place.verdict or ("died" if ready else "start_failed")
        killed = status == -signal.SIGKILL and not place.verdict
        now_s = asyncio.get_running_loop().time()
        sound = ready and (worker.rendered > 0 or bool(worker.sent) or now_s - worker.started_s > _SOUND_LIFE_S)
        if sound:
            place.failures = -1
        elif not worker.refused:
            self._last_error = f"exit status {status}" if reason == "start_failed" else reason
        if not (killed and sound):
            self._storm.note(now_s, f"{reason.replace('_', ' ')}, exit status {status}")
        log.warning(
            "render worker gone",
            worker=place.index,
            pid=worker.pid,
            reason=reason,
            exit_status=status,
            frames=len(worker.held),
        )
        self._listener.on_death(worker, killed, hung=reason == HUNG)
        self._retry(place, reason)

    def _retry(self, place: Place, reason: str) -> None:
        place.failures += 1
        if self._first is not None and not self._first.done() and place.failures >= _FAILURES_TO_GIVE_UP:
            self._first.set_exception(RendererUnavailable(f"Render workers die at start: {self._last_error}."))
        if self._closed or (self._first is not None and self._first.done() and self._first.exception() is not None):
            return
        if self.broken:
            self._listener.on_broken(self.reason)
        place.restarts += 1
        self._listener.on_restart(reason)
        loop = asyncio.get_running_loop()
        backoff_s = self._storm.backoff_s(loop.time())
        if place.failures > 0:
            backoff_s = max(backoff_s, min(_LONGEST_BACKOFF_S, 0.1 * 2**place.failures))
        if backoff_s:
            place.timer = loop.call_later(backoff_s, self._launch, place)
        else:
            self._launch(place)

    def _release(self, worker: WorkerProcess) -> None:
        """Closes the channel, at which an idle worker ends, and waits for the end of the process off the loop."""
        asyncio.get_running_loop().remove_reader(worker.channel.fileno())
        worker.channel.close()
        reaping = asyncio.create_task(asyncio.to_thread(worker.reap, _LAST_WORDS_S))
        self._reaping.add(reaping)
        reaping.add_done_callback(self._reaping.discard)
