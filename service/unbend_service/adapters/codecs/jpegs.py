"""JPEG bodies with libjpeg-turbo by simplejpeg, which is twice as fast as Pillow for the common kinds of files.

Files that simplejpeg does not read to the last byte without a warning are left to Pillow, which forgives more and says
better what is wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import simplejpeg

from unbend_service.application.ports import Bytes

_SUBSAMPLINGS = {"4:4:4": "444", "4:2:2": "422", "4:2:0": "420"}
_LONGEST_SEGMENT_BYTES = 65_533
_ICC_MARK = b"ICC_PROFILE\0"
_ICC_PART_BYTES = _LONGEST_SEGMENT_BYTES - len(_ICC_MARK) - 2


def decode_rgb(body: bytes, place: Callable[[int], Bytes] | None = None) -> Bytes | None:
    """(height, width, 3) uint8 RGB of a YCbCr file, not turned; None for any file that is better left to Pillow.

    Args:
        place: gives the (n,) uint8 memory to decode into.
    """
    try:
        height, width, space, _ = simplejpeg.decode_jpeg_header(body)
        if space != "YCbCr":
            return None
        memory = None if place is None else place(3 * width * height)
        return np.asarray(simplejpeg.decode_jpeg(body, colorspace="RGB", strict=True, buffer=memory))
    except ValueError:
        return None


def decode_luma(body: bytes, least_width: int, least_height: int) -> Bytes | None:
    """(height, width) uint8 luma of a YCbCr or grey file, not turned; None for any file that is better left to Pillow.

    It is decoded at the smallest scale n/8 that is not below ``least_width`` and ``least_height``.
    """
    try:
        if simplejpeg.decode_jpeg_header(body)[2] not in ("YCbCr", "Gray"):
            return None
        luma = simplejpeg.decode_jpeg(
            body, colorspace="GRAY", min_width=least_width, min_height=least_height, strict=True
        )
    except ValueError:
        return None
    return np.asarray(luma)[..., 0]


def encode_packed(
    pixels: Bytes, order: str, quality: int, subsampling: str, exif: bytes | None, icc_profile: bytes | None
) -> bytes:
    """A JFIF file.

    Args:
        pixels: (height, width, 3) uint8, C-contiguous.
        order: ``RGB`` or ``BGR``.
        quality: 1..100.
        subsampling: of chroma: ``4:4:4``, ``4:2:2`` or ``4:2:0``.
        exif: block to keep, with its ``Exif`` mark, at most 65,533 bytes.
        icc_profile: to keep.
    """
    body = simplejpeg.encode_jpeg(pixels, quality, order, _SUBSAMPLINGS[subsampling], fastdct=False)
    return _with_segments(body, exif, icc_profile)


def encode_planes(planes: Sequence[Bytes], quality: int, exif: bytes | None, icc_profile: bytes | None) -> bytes:
    """A JFIF file of luma (h, w) and two chroma planes of half its size, each uint8, full range; even sizes."""
    luma, blue, red = (np.ascontiguousarray(plane) for plane in planes)
    return _with_segments(simplejpeg.encode_jpeg_yuv_planes(luma, blue, red, quality, fastdct=False), exif, icc_profile)


def _with_segments(body: bytes, exif: bytes | None, icc_profile: bytes | None) -> bytes:
    segments = b"" if exif is None else _segment(0xE1, exif)
    if icc_profile is not None:
        parts = range(0, len(icc_profile), _ICC_PART_BYTES)
        for number, first in enumerate(parts, 1):
            mark = _ICC_MARK + bytes((number, len(parts)))
            segments += _segment(0xE2, mark + icc_profile[first : first + _ICC_PART_BYTES])
    if not segments:
        return body
    end = 4 + int.from_bytes(body[4:6])  # of the JFIF segment, which has to be the first
    return body[:end] + segments + body[end:]


def _segment(mark: int, content: bytes) -> bytes:
    return bytes((0xFF, mark)) + (len(content) + 2).to_bytes(2) + content
