from __future__ import annotations

import numpy as np

from unbend_service.adapters.renderers.quarantine import Quarantine
from unbend_service.domain.frames import BLACK, Border, Frame, PixelFormat
from unbend_service.domain.grid import Grid

GRID = Grid.identity()


def frame(*changed: int) -> Frame:
    data = np.arange(64 * 48, dtype=np.int64).astype(np.uint8)
    data[list(changed)] ^= 1
    return Frame(PixelFormat.GRAY8, 64, 48, data)


def test_only_the_very_same_frame_is_kept_out() -> None:
    """One sample, another grid or another border make a frame that may be tried."""
    quarantine = Quarantine()
    assert not quarantine.holds(frame(), GRID, BLACK)
    quarantine.add(frame(), GRID, BLACK)
    assert quarantine.holds(frame(), GRID, BLACK)
    assert not quarantine.holds(frame(0), GRID, BLACK)
    assert not quarantine.holds(frame(1001), GRID, BLACK)
    assert not quarantine.holds(frame(), Grid.identity(3, 4), BLACK)
    assert not quarantine.holds(frame(), GRID, Border(1, 2, 3))


def test_a_quarantine_ends_and_is_bounded() -> None:
    """After its time a frame may try again; the oldest goes when there are too many."""
    now_s = 0.0
    quarantine = Quarantine(keep_s=10, entries=2, clock=lambda: now_s)
    for n in (1, 2, 3):
        quarantine.add(frame(n), GRID, BLACK)
    assert [quarantine.holds(frame(n), GRID, BLACK) for n in (1, 2, 3)] == [False, True, True]
    now_s = 10.5
    assert not quarantine.holds(frame(3), GRID, BLACK)
