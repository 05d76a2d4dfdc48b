"""Frames that cost workers their lives are not let near another one."""

from __future__ import annotations

import hashlib
import time
from collections import OrderedDict
from collections.abc import Callable

from unbend_service.domain.frames import Border, Frame
from unbend_service.domain.grid import Grid

_SAMPLES = 64
_Sketch = tuple[str, int, int, str, Border, bytes]


class Quarantine:
    """Remembers poisonous frames: the picture, with the grid and border that it was to be drawn with.

    To look a frame up costs next to nothing: all of it is read only if it agrees with a poisonous one in everything
    else and in 64 samples.

    Args:
        keep_s: seconds after which a frame may try again, for its deaths may have had another cause.
        entries: frames that are remembered; the oldest goes first.
        clock: seconds that only grow.
    """

    def __init__(self, keep_s: float = 600.0, entries: int = 256, clock: Callable[[], float] = time.monotonic) -> None:
        self._keep_s = keep_s
        self._entries = entries
        self._clock = clock
        self._added_s: OrderedDict[tuple[_Sketch, bytes], float] = OrderedDict()

    def add(self, frame: Frame, grid: Grid, border: Border) -> None:
        """Keeps the frame out from now on."""
        key = _sketch(frame, grid, border), _digest(frame)
        self._added_s[key] = self._clock()
        self._added_s.move_to_end(key)
        while len(self._added_s) > self._entries:
            self._added_s.popitem(last=False)

    def holds(self, frame: Frame, grid: Grid, border: Border) -> bool:
        """Whether the frame is kept out."""
        while self._added_s and next(iter(self._added_s.values())) < self._clock() - self._keep_s:
            self._added_s.popitem(last=False)
        if not self._added_s:
            return False
        sketch = _sketch(frame, grid, border)
        return any(known == sketch for known, _ in self._added_s) and (sketch, _digest(frame)) in self._added_s


def _sketch(frame: Frame, grid: Grid, border: Border) -> _Sketch:
    samples = frame.data[:: max(1, frame.data.size // _SAMPLES)]
    return str(frame.pixel_format), frame.width, frame.height, grid.id, border, samples.tobytes()


def _digest(frame: Frame) -> bytes:
    return hashlib.blake2b(frame.data.data, digest_size=16).digest()
