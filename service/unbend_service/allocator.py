"""How the C library keeps memory that is free."""

from __future__ import annotations

import ctypes
import os
from dataclasses import dataclass

_M_ARENA_MAX = -8
_ARENAS = 2
#: Nothing was to be done for so long: what is free goes back to the system.
REST_S = 5.0


class _MallInfo2(ctypes.Structure):
    """``struct mallinfo2`` of glibc 2.33, over all arenas."""

    _fields_ = tuple(
        (name, ctypes.c_size_t)
        for name in (
            "arena",
            "ordblks",
            "smblks",
            "hblks",
            "hblkhd",
            "usmblks",
            "fsmblks",
            "uordblks",
            "fordblks",
            "keepcost",
        )
    )


@dataclass(frozen=True, slots=True)
class Heap:
    """What malloc holds; Python's own small objects lie elsewhere.

    Attributes:
        used_bytes: handed out, large blocks that are mapped by themselves included.
        free_bytes: kept for the next who asks; part of it may have been given back, address by address.
    """

    used_bytes: int
    free_bytes: int


def share_arenas() -> None:
    """Lets all threads allocate from two arenas of glibc instead of eight for each core; elsewhere nothing happens.

    A frame is allocated by one thread (of gRPC, of a codec) and freed by another. Each thread's own arena then keeps
    what it once needed at most, and the process grows for many minutes before it is flat. ``MALLOC_ARENA_MAX`` of the
    environment goes before. To be called before threads are started: it bounds arenas that are yet to be made.
    """
    if "MALLOC_ARENA_MAX" in os.environ:
        return
    mallopt = _function("mallopt")
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, _ARENAS)


def heap() -> Heap | None:
    """What malloc holds in this process; None where the C library does not say."""
    mallinfo = _function("mallinfo2")
    if mallinfo is None:
        return None
    mallinfo.restype = _MallInfo2
    info = mallinfo()
    return Heap(info.uordblks + info.hblkhd, info.fordblks)


def give_back() -> None:
    """Gives free memory back to the system, that between blocks in use included; elsewhere nothing happens.

    By itself glibc gives back only what lies at the very end, so that one small block which stays keeps all below it.
    """
    trim = _function("malloc_trim")
    if trim is not None:
        trim(0)


def _function(name: str) -> ctypes._NamedFuncPointer | None:
    return getattr(ctypes.CDLL(None), name, None)
