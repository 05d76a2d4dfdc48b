"""Copies of frames into shared memory and out of it, without holding up the event loop."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from unbend_service.application.ports import Bytes

#: A smaller copy takes less time than handing it to a thread, which has to be woken and to wake the event loop.
_INLINE_BYTES = 1 << 20


class Copies:
    """Copies small arrays at once and large ones in threads of its own."""

    def __init__(self) -> None:
        self._threads = ThreadPoolExecutor(max_workers=2, thread_name_prefix="unbend-copy")

    def copy(self, target: Bytes, source: Bytes, then: Callable[[], None]) -> None:
        """Copies ``source`` to ``target``, both (n,) uint8, and calls ``then`` on the event loop, perhaps at once."""
        if source.size <= _INLINE_BYTES:
            np.copyto(target, source)
            then()
            return
        copying = asyncio.get_running_loop().run_in_executor(self._threads, np.copyto, target, source)
        copying.add_done_callback(lambda _: then())

    async def close(self) -> None:
        """Waits for the copies under way."""
        await asyncio.to_thread(self._threads.shutdown)
