"""The parent's side of one worker: its process, its channel, and what it holds."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import OrderedDict, deque
from collections.abc import Iterable
from contextlib import suppress

import numpy as np

from unbend_service.adapters.renderers.channel import (
    Begin,
    Channel,
    FromWorker,
    MapSlot,
    Place,
    Rename,
    Task,
    ToWorker,
    UnmapSlots,
)
from unbend_service.adapters.renderers.jobs import Job
from unbend_service.adapters.renderers.selection import RendererOptions
from unbend_service.application.ports import RendererInfo

#: Mesa's software renderer, and the libraries below numpy, would start a thread for every core of the machine.
_THREAD_LIMITS = ("LP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_STDERR_FD = 2
_GRIDS_KEPT_BYTES = 32 << 20


class WorkerProcess:
    """A started worker process. A new process is executed, never forked, so it inherits neither threads nor contexts.

    Attributes:
        index: place in the pool; the process that replaces a dead one has the same.
        info: its renderer, None until it is ready.
        refused: whether it said why it has no renderer, or none any more.
        held: jobs that were assigned to it.
        sent: jobs that it knows of, in its order of work; the first is the one it renders.
        rendered: frames it has answered.
        started_s: loop time of its start.
    """

    def __init__(
        self, index: int, factory: str, options: RendererOptions, started_s: float, *, deputy: bool = False
    ) -> None:
        self.index = index
        self.info: RendererInfo | None = None
        self.refused = False
        self.held: set[Job] = set()
        self.sent: deque[Job] = deque()
        self.rendered = 0
        self.started_s = started_s
        self._mapped: set[int] = set()
        self._grids: OrderedDict[str, int] = OrderedDict()
        self.channel, theirs = Channel.pair()
        try:
            self._process = subprocess.Popen(
                # -P: a file of the working directory must not stand in for a module of the service
                [sys.executable, "-P", "-m", "unbend_service.adapters.renderers.worker", str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=_STDERR_FD,  # our own standard output may be somebody's video
                process_group=0,  # an interrupt from the keyboard is for the parent to decide on
                pass_fds=(theirs.fileno(),),
                env={**dict.fromkeys(_THREAD_LIMITS, str(options.threads)), **os.environ},
            )
        except OSError:
            self.channel.close()
            raise
        finally:
            theirs.close()
        with suppress(OSError):  # it is gone already, as the channel will show
            self.channel.send(Begin(f"unbend-{'deputy' if deputy else 'render'}{index}", factory, options))

    @property
    def pid(self) -> int:
        return self._process.pid

    def take_over(self) -> None:
        """From now on this deputy is the worker of its place."""
        with suppress(OSError):  # it is gone, as the channel will show
            self.channel.send(Rename(f"unbend-render{self.index}"))

    def begin(self, job: Job) -> None:
        """Tells the worker of a job whose source is in its slot; raises OSError when the worker is gone."""
        slot = job.slot
        if slot is None:
            raise RuntimeError("a job without a slot was sent")
        for memory in (slot, job.region):
            if memory is not None and memory.number not in self._mapped:
                self.channel.send(MapSlot(memory.number, memory.size_bytes), memory.fd)
                self._mapped.add(memory.number)
        known = job.grid.id in self._grids
        self._grids[job.grid.id] = job.grid.source.nbytes
        self._grids.move_to_end(job.grid.id)
        forget = []
        while len(self._grids) > 1 and sum(self._grids.values()) > _GRIDS_KEPT_BYTES:
            forget.append(self._grids.popitem(last=False)[0])
        if not known:
            lattice = job.grid.source.reshape(-1).view(np.uint8)
            slot.memory[job.lattice_offset : job.lattice_offset + lattice.size] = lattice
        frame = job.frame
        source, target = job.places()
        self.channel.send(
            Task(
                number=job.number,
                source=source,
                target=target,
                pixel_format=frame.pixel_format,
                width=frame.width,
                height=frame.height,
                border=job.border,
                threads=job.threads,
                grid_id=job.grid.id,
                lattice=None if known else (job.grid.rows, job.grid.columns),
                lattice_place=Place(slot.number, job.lattice_offset),
                forget=tuple(forget),
            )
        )
        self.sent.append(job)

    def unmap(self, slots: Iterable[int]) -> None:
        """Tells the worker that slots are gone; raises OSError when the worker is gone."""
        if numbers := self._mapped.intersection(slots):
            self._mapped -= numbers
            self.channel.send(UnmapSlots(tuple(numbers)))

    def receive(self) -> FromWorker:
        """The next message; raises as :meth:`Channel.receive`."""
        message, _ = self.channel.receive()
        if isinstance(message, ToWorker):
            raise EOFError
        return message

    def kill(self) -> None:
        """Ends the process at once, whatever it does."""
        self._process.kill()

    def exit_status(self, patience_s: float) -> int | None:
        """How the process ended, -N for signal N; None if it has not within ``patience_s``; blocking."""
        try:
            return self._process.wait(patience_s)
        except subprocess.TimeoutExpired:
            return None

    def reap(self, patience_s: float) -> int:
        """Waits for the process to end, kills it after ``patience_s``; blocking. Returns its exit status."""
        try:
            return self._process.wait(patience_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()
