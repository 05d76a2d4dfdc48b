"""Frames under way in the pool, and the queue of those that wait for a worker."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Collection, Iterator
from contextvars import Context, copy_context
from dataclasses import dataclass, field
from functools import lru_cache

from unbend_service.adapters.renderers.channel import Place
from unbend_service.adapters.renderers.regions import Region
from unbend_service.adapters.renderers.slots import Slot
from unbend_service.application.ports import Bytes, SharedPicture
from unbend_service.domain.frames import Border, Frame
from unbend_service.domain.grid import Grid

_FLOWS_REMEMBERED = 1024


@dataclass(slots=True, eq=False)
class Job:
    """One frame from acceptance to answer.

    Attributes:
        number: unlike that of any other job of the pool.
        flow: whose frame it is; frames of one flow wait for each other, not for those of another. None: its own.
        preferred: index of the worker whose maps and textures are warm for it, -1 if none is.
        accepted_s: loop time of acceptance.
        answer: what the caller waits for; done early when the caller has gone.
        released: set when nobody draws the frame any more, whatever became of it.
        shared: where the frame lies in the memory of a client, if it does.
        region: that memory, from acceptance to ``released``.
        slot: shared memory of our own, from the first assignment to the answer.
        copied: whether the source is in the slot, or need not be.
        blame: grows with every worker that dies while it renders this very frame.
        context: of the caller, so that what is measured counts as his.
        threads: of the processor that it may use.
        passed_over: how often a later frame was taken first because it suited the worker.
        turn: its place in the queue, see JobQueue.
    """

    number: int
    frame: Frame
    grid: Grid
    border: Border
    flow: str | None
    preferred: int
    accepted_s: float
    answer: asyncio.Future[Bytes]
    released: asyncio.Event = field(default_factory=asyncio.Event)
    shared: SharedPicture | None = None
    region: Region | None = None
    slot: Slot | None = None
    copied: bool = False
    blame: int = 0
    threads: int = 1
    passed_over: int = 0
    turn: int = 0
    context: Context = field(default_factory=copy_context)

    @property
    def size_bytes(self) -> int:
        return int(self.frame.data.size)

    @property
    def lattice_offset(self) -> int:
        """Where the lattice lies in the slot, after source and target if they are there; a multiple of 8 bytes."""
        return 0 if self.shared is not None else -(-2 * self.size_bytes // 8) * 8

    @property
    def slot_bytes(self) -> int:
        return self.lattice_offset + self.grid.source.nbytes

    def places(self) -> tuple[Place, Place]:
        """Where source and target lie. Raises RuntimeError before a slot is there."""
        if self.slot is None:
            raise RuntimeError("a job has no slot")
        if self.shared is not None and self.region is not None:
            number = self.region.number
            return Place(number, self.shared.source_offset), Place(number, self.shared.target_offset)
        return Place(self.slot.number, 0), Place(self.slot.number, self.size_bytes)


@lru_cache(maxsize=4096)
def preferred_worker(affinity: str | None, workers: int) -> int:
    """Index of the worker that frames of one ``affinity`` prefer; -1 without affinity.

    Rendezvous hashing: the same key prefers the same worker, and few keys move when the number of workers changes.
    """
    if affinity is None:
        return -1
    key = affinity.encode()
    return max(range(workers), key=lambda index: hashlib.blake2b(key, digest_size=8, salt=index.to_bytes(8)).digest())


class JobQueue:
    """Fair between flows, first in, first out within one; a worker may take a job that prefers it from further back.

    Fair by frames: the next frame of a flow has its turn one round after the one before it, and no earlier than the
    round that is drawn now. However much a flow has waiting, one of its frames at most goes before that of another.
    Bytes are not weighed: all that a flow of large frames may have under way has to be drawn within the deadline too.
    """

    def __init__(self) -> None:
        self._jobs: list[Job] = []
        self._round = 0
        self._turns: dict[str, int] = {}

    def __len__(self) -> int:
        return len(self._jobs)

    def __iter__(self) -> Iterator[Job]:
        return iter(self._jobs)

    def append(self, job: Job) -> None:
        """Puts a new job where its flow's turn is."""
        if not self._jobs:
            self._round = 0
            self._turns.clear()
        if len(self._turns) > _FLOWS_REMEMBERED:
            self._turns = {flow: turn for flow, turn in self._turns.items() if turn > self._round}
        job.turn = self._round + 1
        if job.flow is not None:
            job.turn = self._turns[job.flow] = max(self._round, self._turns.get(job.flow, 0)) + 1
        place = len(self._jobs)
        while place and self._jobs[place - 1].turn > job.turn:
            place -= 1
        self._jobs.insert(place, job)

    def put_first(self, job: Job) -> None:
        """Puts a job back that was already taken once."""
        self._jobs.insert(0, job)

    def remove(self, job: Job) -> bool:
        """Whether the job was there."""
        if job not in self._jobs:
            return False
        self._jobs.remove(job)
        self._round = max(self._round, job.turn - 1)
        return True

    def pick(self, able: Collection[int], workers: int) -> tuple[Job, int | None]:
        """The job to do next, and the worker of ``able`` that it prefers, None if it prefers none of them.

        Looks as far back as there are workers; the first job is passed over at most that many times in a row.
        The job stays in the queue. Raises IndexError on an empty queue.
        """
        head = self._jobs[0]
        for job in self._jobs[:workers] if head.passed_over < workers else (head,):
            if job.preferred in able:
                if job is not head:
                    head.passed_over += 1
                return job, job.preferred
        return head, None
