from __future__ import annotations

import asyncio
import threading

import numpy as np
import pytest

from tests.adapters.renderers import misbehaving
from tests.adapters.renderers.conftest import MakePool, slot_descriptors
from tests.adapters.renderers.test_pool import GRID, expected, frame
from unbend_service.adapters.renderers.leases import LEAST_LENT_BYTES, Lending
from unbend_service.adapters.renderers.slots import Slot, SlotPool
from unbend_service.domain.frames import BLACK

MIB = 1 << 20


def used_slot(slots: SlotPool) -> Slot:
    slot = slots.acquire(MIB)
    assert slot is not None
    return slot


async def test_a_slot_comes_back_once_nobody_holds_what_was_lent() -> None:
    """A view of a view keeps the slot; the last one that goes, in whatever thread, gives it back."""
    slots, returned = SlotPool(8 * MIB), asyncio.Event()
    lending = Lending(slots, 4 * MIB, returned.set)
    slot = used_slot(slots)
    slot.memory[:] = 7
    held = lending.lend(slot, 0, MIB // 2)
    assert held is not None
    part = [held[10:].reshape(2, -1)[1]]
    del held
    await asyncio.sleep(0.01)
    assert (slots.used, lending.lent_bytes) == (1, slot.size_bytes)
    assert (part[0] == 7).all()
    releasing = threading.Thread(target=part.clear)
    releasing.start()
    await asyncio.wait_for(returned.wait(), 5)
    releasing.join()
    assert (slots.used, lending.lent_bytes) == (0, 0)
    slots.close()


async def test_holders_never_keep_more_than_the_limit() -> None:
    """What would pass the limit, and what is small, is not lent but to be copied."""
    slots = SlotPool(8 * MIB)
    lending = Lending(slots, 2 * MIB, lambda: None)
    held = [lending.lend(used_slot(slots), 0, MIB) for _ in range(3)]
    assert [view is None for view in held] == [False, False, True]
    assert lending.lend(used_slot(slots), 0, LEAST_LENT_BYTES - 1) is None
    slots.close()


@pytest.mark.parametrize("megabytes", [4, 64])
async def test_answers_that_are_kept_stay_what_they_are(make_pool: MakePool, megabytes: int) -> None:
    """Frames go on being rendered while every answer is held, however little memory there is, and none is changed by a
    later one, nor by the end of the pool."""
    pool = await make_pool(workers=2, shared_memory_bytes=megabytes * MIB)
    frames = [frame(misbehaving.DRAW, n, 640, 480) for n in range(20)]
    answers = [await pool.render(f, GRID, BLACK) for f in frames]
    await pool.close(1.0)
    for source, answer in zip(frames, answers, strict=True):
        np.testing.assert_array_equal(answer, expected(source))
    del answer, answers
    assert slot_descriptors() == 0
