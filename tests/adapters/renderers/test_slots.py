from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.adapters.renderers.conftest import slot_descriptors
from unbend_service.adapters.renderers.slots import Slot, SlotPool, slot_class_bytes
from unbend_service.domain.errors import RendererUnavailable

MIB = 1 << 20


@pytest.mark.parametrize("size_bytes", [1, 65_536, 65_537, 100_000, 3 * MIB, 8 * MIB + 1, 33_177_600])
def test_a_slot_class_holds_its_frame_and_wastes_little(size_bytes: int) -> None:
    """A frame fits its class, and at most a quarter of a large slot is wasted."""
    wanted = slot_class_bytes(size_bytes)
    assert size_bytes <= wanted <= max(65_536, size_bytes * 1.25)
    assert slot_class_bytes(wanted) == wanted


def test_a_released_slot_is_used_again() -> None:
    """Frames of one size do not make new memory each time."""
    pool = SlotPool(10 * MIB)
    first = pool.acquire(MIB)
    assert first is not None
    pool.release(first)
    assert pool.acquire(MIB - 100_000) is first
    assert pool.size_bytes == MIB
    pool.close()
    assert slot_descriptors() == 0


def test_memory_stays_within_its_bound() -> None:
    """While slots in use leave no room there is none; free ones of other sizes make room, and workers are told."""
    pool = SlotPool(4 * MIB)
    slots = [pool.acquire(MIB) for _ in range(4)]
    assert pool.acquire(MIB) is None
    assert pool.used == 4
    for slot in slots[:2]:
        assert slot is not None
        pool.release(slot)
    large = pool.acquire(2 * MIB)
    assert large is not None
    assert pool.size_bytes == 4 * MIB
    assert pool.take_dropped() == [slot.number for slot in slots[:2] if slot is not None]
    assert pool.take_dropped() == []
    pool.close()
    assert slot_descriptors() == 0


def test_a_frame_that_can_never_fit_names_the_setting() -> None:
    """The operator learns which setting to raise."""
    with pytest.raises(RendererUnavailable, match="shared_memory_bytes"):
        SlotPool(MIB).acquire(2 * MIB)


def test_both_sides_see_the_same_memory() -> None:
    """What the parent writes into a slot is what a worker that maps it reads."""
    parent = Slot.create(1, 65_536)
    worker = Slot(1, os.dup(parent.fd), 65_536)
    parent.memory[100:103] = 1, 2, 3
    assert list(worker.memory[99:104]) == [0, 1, 2, 3, 0]
    held = worker.memory[:10]
    worker.close()
    assert list(held) == [0] * 10
    parent.close()


def test_a_killed_owner_leaves_nothing_behind() -> None:
    """Slots have no names: however their owner ends, /dev/shm is as it was."""
    before = sorted(os.listdir("/dev/shm"))
    script = (
        "import os, signal\n"
        "from unbend_service.adapters.renderers.slots import SlotPool\n"
        "slot = SlotPool(1 << 24).acquire(1 << 20)\n"
        "slot.memory[:] = 1\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == -9
    left = [name for name in os.listdir("/dev/shm") if name not in before and "unbend" in name]
    assert left == []
