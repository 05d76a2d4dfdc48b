"""Messages from the wire, parsed where a broken one can be answered as what it is: the caller's mistake.

gRPC would parse them before any code of ours runs, answer garbage as an error of the server, and let a message that is
small on the wire grow to gigabytes: an empty guide takes two bytes there and dozens in memory.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from typing import Any

from google.protobuf.message import DecodeError

from unbend_service.domain.errors import BodyTooLarge, ProtocolViolation

#: Of everything in a message but its payload.
_LONGEST_REST_BYTES = 64 << 10
_MOST_FIELDS = 64
_VARINT, _FIXED64, _LENGTH, _FIXED32 = 0, 1, 2, 5

Parse = Callable[[bytes], Any]

#: Field numbers that lead to the pixels, the file or the lattice of a method's requests; others have no payload.
_PAYLOADS: dict[str, tuple[int, ...]] = {
    "/unbend.v1.EstimationService/Estimate": (2,),  # data
    "/unbend.v1.EstimationService/EstimateGuides": (2,),  # data
    "/unbend.v1.CorrectionService/Correct": (2,),  # data
    "/unbend.v1.CorrectionService/CorrectStream": (2, 3),  # frame.data
    "/unbend.v1.GridService/PutGrid": (1, 3),  # grid.source
}


def parse(method: str, parse_message: Parse, raw: bytes) -> Any:
    """One message.

    Args:
        method: full name, with its slashes.
        parse_message: the generated ``FromString``.

    Raises:
        ProtocolViolation: it is no such message.
        BodyTooLarge: it holds more beside its payload than any good one does.
    """
    if len(raw) > _LONGEST_REST_BYTES:
        payload = _PAYLOADS.get(method)
        rest_bytes = len(raw) - (_payload_bytes(memoryview(raw), payload) if payload else 0)
        if rest_bytes > _LONGEST_REST_BYTES:
            raise BodyTooLarge(
                f"The message has {rest_bytes} bytes beside its picture or lattice.",
                allowed=f"{_LONGEST_REST_BYTES} bytes",
            )
    try:
        return parse_message(raw)
    except DecodeError as error:
        raise ProtocolViolation("The message cannot be read.", allowed="a message of unbend.v1") from error


async def parse_all(method: str, parse_message: Parse, requests: AsyncIterator[bytes]) -> AsyncIterator[Any]:
    """The messages of a stream; raises as :func:`parse`."""
    async for raw in requests:
        yield parse(method, parse_message, raw)


def _payload_bytes(raw: memoryview, path: tuple[int, ...]) -> int:
    """Bytes of the payload in a serialized message; 0 if that is broken or has too many fields to look at."""
    position, found, fields = 0, 0, 0
    while position < len(raw):
        fields += 1
        key, position = _varint(raw, position)
        number, kind = key >> 3, key & 7
        if fields > _MOST_FIELDS or position < 0:
            return 0
        if kind == _VARINT:
            _, position = _varint(raw, position)
        elif kind in (_FIXED64, _FIXED32):
            position += 8 if kind == _FIXED64 else 4
        elif kind == _LENGTH:
            length, position = _varint(raw, position)
            if position < 0 or position + length > len(raw):
                return 0
            if number == path[0]:
                inner = raw[position : position + length]
                found += length if len(path) == 1 else _payload_bytes(inner, path[1:])
            position += length
        else:
            return 0
        if position < 0:
            return 0
    return found


def _varint(raw: memoryview, position: int) -> tuple[int, int]:
    """Value and the position after it, which is negative if there is none."""
    value = 0
    for shift in range(0, 70, 7):
        if position >= len(raw):
            return 0, -1
        byte = raw[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position
    return 0, -1
