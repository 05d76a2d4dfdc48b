"""The time that a caller gives a call, held at every stage of it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from unbend_service.domain.errors import DeadlineExceeded


@asynccontextmanager
async def deadline(left_s: float | None) -> AsyncIterator[None]:
    """Around the work on one call: whatever it waits for is cancelled after ``left_s`` seconds, if that is a number.

    Raises:
        DeadlineExceeded: the time is over.
    """
    try:
        async with asyncio.timeout(left_s) as timeout:
            yield
    except TimeoutError:
        if not timeout.expired():
            raise
        raise DeadlineExceeded(
            f"The call was not finished within the {max(0.0, left_s or 0.0):.3g} s that the caller gave it."
        ) from None
