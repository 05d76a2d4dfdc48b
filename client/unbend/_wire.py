"""Frames as messages of the wire, without the copies that protobuf makes of a bytes field.

Protobuf copies a picture when it is set, written, parsed and read. Here its bytes are put between the other fields when
a message is written, once, and shown where they lie when it is read; all other fields are left to protobuf. Both sides
use this: what goes over the wire is unbend.v1 as it stands in proto/.
"""

from __future__ import annotations

from typing import Any

#: Number of ``frame`` in CorrectStreamRequest and of ``data`` in StreamFrame.
FRAME_FIELD, FRAME_DATA_FIELD = 2, 3
#: Number of ``result`` in CorrectStreamResponse and of ``data`` in StreamResult.
RESULT_FIELD, RESULT_DATA_FIELD = 3, 4

_VARINT, _FIXED64, _LENGTH, _FIXED32 = 0, 1, 2, 5
_LONGEST_VARINT = 10


def attach(field: int, rest: bytes, data_field: int, data: Any) -> bytes:
    """A message whose only field is the message ``field``, which is made of ``rest`` and its bytes field.

    Args:
        field, data_field: numbers of fields.
        rest: the inner message without its bytes field, serialized.
        data: contiguous buffer of bytes; copied once.
    """
    size_bytes = memoryview(data).nbytes
    if not size_bytes:
        return b"".join((_tag(field), _varint(len(rest)), rest))
    head = _tag(data_field) + _varint(size_bytes)
    return b"".join((_tag(field), _varint(len(rest) + len(head) + size_bytes), rest, head, data))


def detach(body: bytes, field: int, data_field: int) -> tuple[bytes, memoryview] | None:
    """Inverse of :func:`attach` for any encoding of such a message: its rest, and a view of its bytes field.

    Returns:
        None for a message that is something else, or is written in an unusual way (the field or its bytes field
        repeated, another field beside it, broken): protobuf knows what to make of it.
    """
    head = _tag(field)
    if not body.startswith(head):
        return None
    try:
        length, first = _read_varint(body, len(head))
        if first + length != len(body):
            return None
        found: tuple[int, int, int] | None = None
        at = first
        while at < len(body):
            start = at
            tag, at = _read_varint(body, at)
            kind = tag & 7
            if kind == _LENGTH:
                length, at = _read_varint(body, at)
                if tag >> 3 == data_field:
                    if found is not None:
                        return None
                    found = start, at, at + length
                at += length
            elif kind == _VARINT:
                _, at = _read_varint(body, at)
            elif kind in (_FIXED64, _FIXED32):
                at += 8 if kind == _FIXED64 else 4
            else:
                return None
    except IndexError:
        return None
    if at != len(body):
        return None
    if found is None:
        return body[first:], memoryview(b"")
    start, begin, end = found
    return body[first:start] + body[end:], memoryview(body)[begin:end]


def _tag(field: int) -> bytes:
    return _varint(field << 3 | _LENGTH)


def _varint(value: int) -> bytes:
    written = bytearray()
    while value > 0x7F:
        written.append(value & 0x7F | 0x80)
        value >>= 7
    written.append(value)
    return bytes(written)


def _read_varint(body: bytes, at: int) -> tuple[int, int]:
    """A number and where it ends; raises IndexError for one that is cut or too long."""
    value = 0
    for place in range(_LONGEST_VARINT):
        byte = body[at + place]
        value |= (byte & 0x7F) << 7 * place
        if byte < 0x80:
            return value, at + place + 1
    raise IndexError
