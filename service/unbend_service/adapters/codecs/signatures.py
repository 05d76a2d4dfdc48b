"""Which image format some bytes are, told by their first bytes alone."""

from __future__ import annotations

import re

from unbend_service.domain.errors import EmptyBody, InvalidImage, UnsupportedMediaType

#: Encoders write 10 to 20 scans, the format allows any number, and each goes over all of the picture again.
MOST_SCANS = 100
_SCAN = b"\xff\xda"
_SCANS = re.compile(_SCAN)
READ_FORMATS = ("jpeg", "png", "webp", "tiff", "bmp")


def sniff(body: bytes) -> str:
    """The format by magic number; names and Content-Type say nothing.

    Raises:
        EmptyBody: no bytes.
        UnsupportedMediaType: none of READ_FORMATS.
    """
    if not body:
        raise EmptyBody("The body is empty; an image was expected.", allowed=", ".join(READ_FORMATS))
    if body.startswith(b"\xff\xd8\xff"):
        return "jpeg"
    if body.startswith(b"\x89PNG\r\n\x1a\n"):
        return "png"
    if body.startswith(b"RIFF") and body[8:12] == b"WEBP":
        return "webp"
    if body.startswith((b"II*\0", b"MM\0*")):
        return "tiff"
    if body.startswith(b"BM"):
        return "bmp"
    raise UnsupportedMediaType("The body is not an image of a known format.", allowed=", ".join(READ_FORMATS))


def announced_size(body: bytes, image_format: str) -> tuple[int, int] | None:
    """(width, height) in pixels as the first bytes say, so that a bomb is called one even if nothing follows.

    None where Pillow says it as early. Raises InvalidImage.
    """
    if image_format == "webp":
        return _webp_size(body)
    if image_format == "png" and len(body) >= 24:
        return int.from_bytes(body[16:20], "big"), int.from_bytes(body[20:24], "big")
    return None


def _webp_size(body: bytes) -> tuple[int, int]:
    """(width, height) in pixels of a WebP canvas, without its decoder, which allocates the canvas when it is made.

    RFC 9649, sections 2.5 to 2.7. Raises InvalidImage.
    """
    chunk = body[12:16]
    if chunk == b"VP8X" and len(body) >= 30:
        return int.from_bytes(body[24:27], "little") + 1, int.from_bytes(body[27:30], "little") + 1
    if chunk == b"VP8L" and len(body) >= 25 and body[20] == 0x2F:
        bits = int.from_bytes(body[21:25], "little")
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if chunk == b"VP8 " and len(body) >= 30 and body[23:26] == b"\x9d\x01\x2a":
        return int.from_bytes(body[26:28], "little") & 0x3FFF, int.from_bytes(body[28:30], "little") & 0x3FFF
    raise InvalidImage("The webp header is broken or cut off.")


def check_scans(body: bytes) -> None:
    """Raises InvalidImage for a JPEG of more scans than any encoder writes.

    Segments before the first scan are skipped by their lengths: a thumbnail has scans of its own. In the samples
    themselves no byte pair looks like the start of a scan.
    """
    position = 2
    while position + 4 <= len(body) and body[position] == 0xFF and body[position : position + 2] != _SCAN:
        alone = body[position + 1] in (0x01, 0xFF, *range(0xD0, 0xD9))  # fill bytes, and markers without a length
        position += 1 if body[position + 1] == 0xFF else 2
        if not alone:
            position += int.from_bytes(body[position : position + 2])
    scans = sum(1 for _ in _SCANS.finditer(body, position))  # bytes.count stumbles over every 0xff of the samples
    if scans > MOST_SCANS:
        raise InvalidImage(f"The jpeg has {scans} scans.", allowed=f"{MOST_SCANS}")
