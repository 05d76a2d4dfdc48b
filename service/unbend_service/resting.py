"""Memory of the parent process that goes back to the system while there is nothing to do."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from unbend_service.allocator import REST_S, give_back

#: Under load it goes back only so often: it takes some milliseconds, in which others who allocate wait.
_BUSY_S = 60.0


@contextmanager
def tended(active: Callable[[], int]) -> Iterator[None]:
    """Gives free memory back now and then: when ``active()`` calls are none, or else once a minute."""
    task = asyncio.create_task(_tend(active))
    try:
        yield
    finally:
        task.cancel()


async def _tend(active: Callable[[], int]) -> None:
    clock = asyncio.get_running_loop().time
    given_s = clock()
    while True:
        await asyncio.sleep(REST_S)
        if not active() or clock() - given_s >= _BUSY_S:
            given_s = clock()
            await asyncio.to_thread(give_back)
