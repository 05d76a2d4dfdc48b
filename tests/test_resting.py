from __future__ import annotations

import asyncio

import pytest

from unbend_service import resting
from unbend_service.resting import tended


async def test_memory_is_given_back_at_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    """While calls are under way it is left alone, for a while; soon after the last it is given back."""
    given = asyncio.Event()
    active = 1
    monkeypatch.setattr(resting, "REST_S", 0.01)
    loop = asyncio.get_running_loop()
    monkeypatch.setattr(resting, "give_back", lambda: loop.call_soon_threadsafe(given.set))
    with tended(lambda: active):
        await asyncio.sleep(0.1)
        assert not given.is_set()
        active = 0
        await asyncio.wait_for(given.wait(), 10)
        active = 1
        await asyncio.sleep(0.05)
        given.clear()
        monkeypatch.setattr(resting, "_BUSY_S", 0.0)
        await asyncio.wait_for(given.wait(), 10)
