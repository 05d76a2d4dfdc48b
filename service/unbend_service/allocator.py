"""How the C library keeps memory that is free."""

from __future__ import annotations

import ctypes
import os

_M_ARENA_MAX = -8
_ARENAS = 2


def share_arenas() -> None:
    """Lets all threads allocate from two arenas of glibc instead of eight for each core; elsewhere nothing happens.

    A frame is allocated by one thread (of gRPC, of a codec) and freed by another. Each thread's own arena then keeps
    what it once needed at most, and the process grows for many minutes before it is flat. ``MALLOC_ARENA_MAX`` of the
    environment goes before. To be called before threads are started: it bounds arenas that are yet to be made.
    """
    if "MALLOC_ARENA_MAX" in os.environ:
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, _ARENAS)
