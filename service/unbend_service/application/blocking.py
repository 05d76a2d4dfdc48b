"""Blocking work (decode, encode, estimate, fit) kept off the event loop, in a bounded number of threads."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from typing import Any, ParamSpec, TypeVar

from unbend_service.application.ports import Meter
from unbend_service.domain.errors import QueueFull

P = ParamSpec("P")
R = TypeVar("R")


class BlockingWork:
    """Runs functions in threads; refuses work once too much of it waits.

    Args:
        threads: functions that run at once.
        queue_length: functions that may wait.
        waiting: threads besides for the stage ``decode``, which waits for other processes and keeps no core busy;
            0: it has none of its own.
    """

    def __init__(self, threads: int, queue_length: int, meter: Meter, *, waiting: int = 0) -> None:
        self._executor = ThreadPoolExecutor(threads, thread_name_prefix="unbend-blocking")
        self._waiting = self._executor
        if waiting:
            self._waiting = ThreadPoolExecutor(waiting, thread_name_prefix="unbend-waiting")
        self._bound = threads + queue_length
        self._pending = 0
        self._meter = meter

    async def run(self, stage: str, function: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
        """``function(*args, **kwargs)`` in a thread; its duration is counted as ``stage``.

        Raises:
            QueueFull: as many calls as are allowed wait already.
        """
        if self._pending >= self._bound:
            self._meter.rejected("queue_full")
            raise QueueFull(
                "Too many images wait to be decoded or estimated.", setting="queue_frames", retry_after_s=1.0
            )
        self._pending += 1
        context = copy_context()  # so that the duration counts as the caller's
        loop = asyncio.get_running_loop()
        executor = self._waiting if stage == "decode" else self._executor
        work = loop.run_in_executor(executor, context.run, self._timed, stage, function, args, kwargs)
        work.add_done_callback(self._finished)
        return await work

    def _finished(self, _: asyncio.Future[R]) -> None:
        self._pending -= 1

    def _timed(self, stage: str, function: Callable[..., R], args: tuple[Any, ...], kwargs: dict[str, Any]) -> R:
        start = time.perf_counter()
        try:
            return function(*args, **kwargs)
        finally:
            self._meter.stage(stage, time.perf_counter() - start)

    def close(self) -> None:
        """Lets running calls end and forgets those that wait."""
        for executor in (self._executor, self._waiting):
            executor.shutdown(wait=False, cancel_futures=True)
