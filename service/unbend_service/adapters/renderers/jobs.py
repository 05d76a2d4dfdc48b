"""Frames under way in the pool, and the queue of those that wait for a worker."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import lru_cache

from unbend_service.adapters.renderers.slots import Slot
from unbend_service.application.ports import Bytes
from unbend_service.domain.frames import Border, Frame
from unbend_service.domain.grid import Grid


@dataclass(slots=True, eq=False)
class Job:
    """One frame from acceptance to answer.

    Attributes:
        number: unlike that of any other job of the pool.
        preferred: index of the worker whose maps and textures are warm for it, -1 if none is.
        accepted_s: loop time of acceptance.
        answer: what the caller waits for; done early when the caller has gone.
        slot: shared memory, from the first assignment to the answer.
        copied: whether the source is in the slot.
        blame: grows with every worker that dies while it renders this very frame.
        passed_over: how often a later frame was taken first because it suited the worker.
    """

    number: int
    frame: Frame
    grid: Grid
    border: Border
    preferred: int
    accepted_s: float
    answer: asyncio.Future[Bytes]
    slot: Slot | None = None
    copied: bool = False
    blame: int = 0
    passed_over: int = 0

    @property
    def size_bytes(self) -> int:
        return int(self.frame.data.size)

    @property
    def lattice_offset(self) -> int:
        """Where the lattice lies in the slot, after source and target; a multiple of 8 bytes."""
        return -(-2 * self.size_bytes // 8) * 8

    @property
    def slot_bytes(self) -> int:
        return self.lattice_offset + self.grid.source.nbytes


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
    """First in, first out, but a worker may take a job that prefers it from a little further back."""

    def __init__(self) -> None:
        self._jobs: list[Job] = []

    def __len__(self) -> int:
        return len(self._jobs)

    def __iter__(self) -> Iterator[Job]:
        return iter(self._jobs)

    def append(self, job: Job) -> None:
        self._jobs.append(job)

    def put_first(self, job: Job) -> None:
        """Puts a job back that was already taken once."""
        self._jobs.insert(0, job)

    def remove(self, job: Job) -> bool:
        """Whether the job was there."""
        if job not in self._jobs:
            return False
        self._jobs.remove(job)
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
