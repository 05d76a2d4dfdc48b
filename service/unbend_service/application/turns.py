"""The share of the service that streams may use at once."""

from __future__ import annotations

import asyncio
import random
from collections import OrderedDict, deque
from collections.abc import Awaitable, Callable
from typing import TypeVar

from unbend_service.domain.errors import QueueFull

R = TypeVar("R")

_FIRST_PAUSE_S = 0.005
_LONGEST_PAUSE_S = 0.1


class Turns:
    """Lets streams take turns: whoever has been served least goes next, whatever the others have waiting.

    A single call is refused when a queue is full; a stream has agreed to wait, so its frames queue here, outside, and
    leave room for single calls.
    """

    def __init__(self, at_once: int, patience_s: float) -> None:
        self._free = at_once
        self._patience_s = patience_s
        self._waiting: OrderedDict[str, deque[asyncio.Future[None]]] = OrderedDict()

    async def run(self, stream: str, work: Callable[[], Awaitable[R]]) -> R:
        """``await work()`` when it is the turn of ``stream``, again if a queue is full all the same.

        Raises:
            QueueFull: a queue stayed full for ``patience_s`` seconds.
        """
        await self._turn(stream)
        try:
            return await self._try(work)
        finally:
            self._free += 1
            self._next()

    async def _turn(self, stream: str) -> None:
        if self._free and not self._waiting:
            self._free -= 1
            return
        turn: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.setdefault(stream, deque()).append(turn)
        try:
            await turn
        except asyncio.CancelledError:
            if turn.done() and not turn.cancelled():  # its turn came in the very moment
                self._free += 1
                self._next()
            raise

    def _next(self) -> None:
        """Gives free turns away, one to each stream in a circle."""
        while self._free and self._waiting:
            stream, turns = self._waiting.popitem(last=False)
            while turns and turns[0].done():  # cancelled
                turns.popleft()
            if turns:
                turns.popleft().set_result(None)
                self._free -= 1
            if turns:
                self._waiting[stream] = turns

    async def _try(self, work: Callable[[], Awaitable[R]]) -> R:
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
