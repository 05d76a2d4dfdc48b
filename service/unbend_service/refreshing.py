"""Files that are read again while the service runs: tokens and certificates."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress

import structlog

from unbend_service.application.access import Access
from unbend_service.domain.errors import UnbendError
from unbend_service.transport.tls import Certificates

#: A token that is taken back is good for so long at most.
_LOOK_EVERY_S = 1.0

log = structlog.get_logger(__name__)


@contextmanager
def refreshed(access: Access, certificates: Certificates | None) -> Iterator[None]:
    """Looks for changes every second, and at once after SIGHUP.

    What cannot be read any more is logged once, and what was there before stays: a slip of an editor locks nobody out.
    """
    refreshers: dict[str, Callable[[], Awaitable[bool]]] = {}
    if access.required:
        refreshers["tokens"] = access.refresh
    if certificates is not None:
        refreshers["certificates"] = lambda: asyncio.to_thread(certificates.refresh)
    if not refreshers:
        yield
        return
    loop, asked = asyncio.get_running_loop(), asyncio.Event()
    loop.add_signal_handler(signal.SIGHUP, asked.set)
    task = asyncio.create_task(_refresh(refreshers, asked))
    try:
        yield
    finally:
        task.cancel()
        loop.remove_signal_handler(signal.SIGHUP)


async def _refresh(refreshers: dict[str, Callable[[], Awaitable[bool]]], asked: asyncio.Event) -> None:
    while True:
        with suppress(TimeoutError):
            await asyncio.wait_for(asked.wait(), _LOOK_EVERY_S)
        asked.clear()
        for what, refresh in refreshers.items():
            try:
                if await refresh():
                    log.info("read again", what=what)
            except UnbendError as error:
                log.error("what was there before stays", what=what, message=str(error))
            except Exception:
                log.exception("what was there before stays", what=what)
