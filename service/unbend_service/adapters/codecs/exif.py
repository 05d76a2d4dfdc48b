"""EXIF blocks: their orientation is read and neutralised in place, all else stays byte for byte.

Serialising a parsed block anew would move the data that maker notes point to; patching it does not.
"""

from __future__ import annotations

import struct

_ORIENTATION = 0x0112
_SHORT = 3
_PREFIX = b"Exif\0\0"


def bare(block: bytes) -> bytes:
    """The TIFF structure of an EXIF block, without the prefixes that JPEG files put before it."""
    while block.startswith(_PREFIX):
        block = block[len(_PREFIX) :]
    return block


def orientation(block: bytes) -> int:
    """1..8 as EXIF 2.32, section 4.6.4 has it; 1 if the block says nothing usable."""
    found = _find(block)
    if found is None:
        return 1
    order, offset, _ = found
    if offset is None:
        return 1
    value = int(struct.unpack_from(order + "H", block, offset)[0])
    return value if 1 <= value <= 8 else 1


def upright(block: bytes) -> bytes | None:
    """The same block with orientation 1 and without its thumbnail, which shows the picture before correction.

    None if the block cannot be read.
    """
    found = _find(block)
    if found is None:
        return None
    order, offset, next_directory = found
    patched = bytearray(block)
    if offset is not None:
        struct.pack_into(order + "H", patched, offset, 1)
    struct.pack_into(order + "I", patched, next_directory, 0)
    return bytes(patched)


def _find(block: bytes) -> tuple[str, int | None, int] | None:
    """Byte order, offset of the orientation value, offset of the link to the thumbnail directory."""
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(block[:4])
    try:
        if order is None:
            return None
        (directory,) = struct.unpack_from(order + "I", block, 4)
        (count,) = struct.unpack_from(order + "H", block, directory)
        link = directory + 2 + 12 * count
        struct.unpack_from(order + "I", block, link)
        for entry in range(directory + 2, link, 12):
            tag, kind = struct.unpack_from(order + "HH", block, entry)
            if tag == _ORIENTATION and kind == _SHORT:
                return order, entry + 8, link
    except struct.error:
        return None
    return order, None, link
