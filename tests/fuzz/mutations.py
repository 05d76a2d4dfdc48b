"""Bytes, a little wrong."""

from __future__ import annotations

import random
import struct

_NUMBERS = [0, 1, 2, 0x7F, 0x80, 0xFF, 0x100, 0x7FFF, 0x8000, 0xFFFF, 0x10000, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF]
_TEXTS = [
    b"NaN",
    b"Infinity",
    b"-1",
    b"1e999",
    b"null",
    b"[]",
    b"{}",
    b'""',
    b"\x00",
    b"\xff\xfe",
    b"%00",
    b"..",
    b"9" * 40,
]


def mutated(rng: random.Random, data: bytes, other: bytes = b"") -> bytes:
    """``data`` after one to four random changes; ``other`` may lend a piece."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4))):
        out = _changed(rng, out, other)
    return bytes(out)


def _changed(rng: random.Random, out: bytearray, other: bytes) -> bytearray:
    if not out:
        return bytearray(rng.randbytes(rng.randrange(1, 64)))
    # heads matter more than samples
    place = rng.randrange(min(len(out), 64 if rng.random() < 0.5 else len(out)))
    match rng.randrange(9):
        case 0:
            out[place] ^= 1 << rng.randrange(8)
        case 1:
            out[place] = rng.randrange(256)
        case 2:
            number = rng.choice(_NUMBERS)
            width = rng.choice("BHIQ")
            packed = struct.pack(rng.choice("<>") + width, number & ((1 << 8 * struct.calcsize(width)) - 1))
            out[place : place + len(packed)] = packed
        case 3:
            del out[place:]
        case 4:
            del out[place : place + rng.randrange(1, 32)]
        case 5:
            piece = bytes(out[place : place + rng.randrange(1, 64)])
            out[place:place] = piece * rng.choice((1, 2, 50))
        case 6:
            out[place:place] = rng.randbytes(rng.randrange(1, 32))
        case 7:
            first = rng.randrange(len(other)) if other else 0
            out[place : place + 64] = other[first : first + rng.randrange(1, 128)]
        case _:
            out[place : place + rng.randrange(4)] = rng.choice(_TEXTS)
    return out
