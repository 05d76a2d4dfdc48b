"""The share of the service that streams may use at once."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Awaitable, Callable
from typing import TypeVar

from unbend_service.domain.errors import QueueFull

R = TypeVar("R")

_FIRST_PAUSE_S = 0.005
_LONGEST_PAUSE_S = 0.1


class Turns:
    """Lets the frames of all streams take turns, first come first served.

    A single call is refused when a queue is full; a stream has agreed to wait, so its frames queue here, outside, and
    leave room for single calls.
    """

    def __init__(self, at_once: int, patience_s: float) -> None:
        self._turn = asyncio.Semaphore(at_once)
        self._patience_s = patience_s

    async def run(self, work: Callable[[], Awaitable[R]]) -> R:
        """``await work()`` when it is its turn, again if a queue is full all the same.

        Raises:
            QueueFull: a queue stayed full for ``patience_s`` seconds.
        """
        async with self._turn:
            loop = asyncio.get_running_loop()
            end = loop.time() + self._patience_s
            pause_s = _FIRST_PAUSE_S
            while True:
                try:
                    return await work()
                except QueueFull:
                    if loop.time() + pause_s > end:
                        raise
                await asyncio.sleep(pause_s * random.uniform(0.5, 1.5))
                pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)
