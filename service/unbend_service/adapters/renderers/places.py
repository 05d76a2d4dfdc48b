"""Where a render worker stands, and its successors after it."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

from unbend_service.adapters.renderers.worker_process import WorkerProcess
from unbend_service.application.ports import WorkerState


@dataclass(slots=True, eq=False)
class Place:
    """One place of the pool.

    Attributes:
        failures: workers in a row that died here before they were of use.
        timer: the limit of what it does now (starting, rendering one frame), or the wait before the next start.
        suspicion: the moment at which a deputy is started.
        deputy: takes over when the worker is gone.
        dismissal: the moment at which the deputy goes because it was not needed.
        verdict: why it was killed, if it was.
    """

    index: int
    worker: WorkerProcess | None = None
    restarts: int = 0
    failures: int = 0
    timer: asyncio.TimerHandle | None = None
    suspicion: asyncio.TimerHandle | None = None
    deputy: WorkerProcess | None = None
    dismissal: asyncio.TimerHandle | None = None
    verdict: str = ""

    def stop_timer(self) -> None:
        for timer in (self.timer, self.suspicion):
            if timer is not None:
                timer.cancel()
        self.timer = self.suspicion = None

    def keep_deputy(self) -> None:
        if self.dismissal is not None:
            self.dismissal.cancel()
            self.dismissal = None

    def state(self) -> WorkerState:
        worker = self.worker
        if worker is None:
            state = "dead"
        elif worker.info is None:
            state = "starting"
        else:
            state = "busy" if worker.held else "ready"
        return WorkerState(f"render{self.index}", state, None if worker is None else worker.pid, self.restarts)
