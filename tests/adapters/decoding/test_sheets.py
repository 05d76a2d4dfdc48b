"""Shared memory for decoding."""

from __future__ import annotations

import os
import time

import pytest

from unbend_service.adapters.decoding.sheets import Sheets
from unbend_service.domain.errors import MemoryFull


def held() -> int:
    """Descriptors of slots that this process holds."""
    found = 0
    for name in os.listdir("/proc/self/fd"):
        try:
            found += "unbend-slot" in os.readlink(f"/proc/self/fd/{name}")
        except FileNotFoundError:
            continue
    return found


def eventually_held(count: int) -> bool:
    end = time.monotonic() + 10
    while held() != count and time.monotonic() < end:
        time.sleep(0.02)
    return held() == count


def test_a_warm_sheet_is_used_again_and_given_back_at_rest() -> None:
    before = held()
    sheets = Sheets(1 << 24, 1 << 24, "pictures_bytes", rest_s=0.3)
    first = sheets.acquire(5000)
    sheets.release(first)

    assert sheets.acquire(5000) is first

    sheets.release(first)
    assert held() > before
    assert eventually_held(before)
    sheets.release(sheets.acquire(5000))
    assert eventually_held(before)
    sheets.close()


def test_what_somebody_looks_at_outlives_the_rest() -> None:
    before = held()
    sheets = Sheets(1 << 24, 1 << 24, "pictures_bytes", rest_s=0.1)
    slot = sheets.acquire(5000)
    slot.memory[:3] = 7
    seen = sheets.lend(slot, 3)
    time.sleep(0.4)

    assert seen.tolist() == [7, 7, 7]

    del seen, slot
    assert eventually_held(before)
    sheets.close()


def test_more_than_is_allowed_is_refused_by_name() -> None:
    sheets = Sheets(8192, 8192, "pictures_bytes")
    with pytest.raises(MemoryFull, match="pictures_bytes"):
        sheets.acquire(1 << 20)
    sheets.close()
