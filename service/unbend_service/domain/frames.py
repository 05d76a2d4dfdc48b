"""Pixel formats and raw frames: how the bytes of one picture are laid out.

Frames are pixels and nothing else: rows from top to bottom, no padding between rows, planes one after the other.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from unbend_service.domain.errors import InvalidFrame, InvalidOption, UnsupportedPixelFormat

Bytes = npt.NDArray[np.uint8]


class PixelFormat(StrEnum):
    """Raw pixel formats, named as FFmpeg names them where both have them.

    ``yuvj420p`` never comes over the wire: it is what a 4:2:0 JPEG holds, i420 in full range.
    """

    GRAY8 = "gray8"
    RGB24 = "rgb24"
    BGR24 = "bgr24"
    RGBA = "rgba"
    BGRA = "bgra"
    I420 = "i420"
    NV12 = "nv12"
    YUVJ420P = "yuvj420p"

    @classmethod
    def parse(cls, name: str) -> PixelFormat:
        """Raises UnsupportedPixelFormat for a name that is not of the list."""
        try:
            return cls(name)
        except ValueError:
            raise UnsupportedPixelFormat(f"Unknown pixel format {name!r}.", allowed=", ".join(cls)) from None

    @property
    def has_alpha(self) -> bool:
        return self in (PixelFormat.RGBA, PixelFormat.BGRA)


@dataclass(frozen=True, slots=True)
class Plane:
    """One plane of a frame.

    Attributes:
        width, height: samples, in the plane's own resolution.
        channels: interleaved samples per position.
        offset: bytes from the start of the frame.
        chroma: whether the plane carries colour differences, whose neutral value is 128.
    """

    width: int
    height: int
    channels: int
    offset: int
    chroma: bool

    @property
    def size_bytes(self) -> int:
        return self.width * self.height * self.channels


_PACKED_CHANNELS = {
    PixelFormat.GRAY8: 1,
    PixelFormat.RGB24: 3,
    PixelFormat.BGR24: 3,
    PixelFormat.RGBA: 4,
    PixelFormat.BGRA: 4,
}


def planes(pixel_format: PixelFormat, width: int, height: int) -> tuple[Plane, ...]:
    """The planes of a frame of ``width`` x ``height`` pixels; half-resolution chroma is rounded up for odd sizes."""
    if channels := _PACKED_CHANNELS.get(pixel_format):
        return (Plane(width, height, channels, 0, False),)
    luma = Plane(width, height, 1, 0, False)
    half_width, half_height = (width + 1) // 2, (height + 1) // 2
    if pixel_format is PixelFormat.NV12:
        return luma, Plane(half_width, half_height, 2, luma.size_bytes, True)
    u = Plane(half_width, half_height, 1, luma.size_bytes, True)
    return luma, u, Plane(half_width, half_height, 1, u.offset + u.size_bytes, True)


def frame_size_bytes(pixel_format: PixelFormat, width: int, height: int) -> int:
    """Bytes of one frame."""
    return sum(plane.size_bytes for plane in planes(pixel_format, width, height))


@dataclass(frozen=True, slots=True)
class Frame:
    """One raw picture.

    Attributes:
        pixel_format: how ``data`` is laid out.
        width, height: pixels, both at least 1.
        data: (size_bytes,) uint8, C-contiguous, possibly a read-only view of somebody else's buffer.
    """

    pixel_format: PixelFormat
    width: int
    height: int
    data: Bytes

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise InvalidFrame(f"A frame of {self.width}x{self.height} pixels has no picture.")
        expected = frame_size_bytes(self.pixel_format, self.width, self.height)
        if self.data.dtype != np.uint8 or self.data.ndim != 1 or self.data.size != expected:
            raise InvalidFrame(
                f"A {self.pixel_format} frame of {self.width}x{self.height} pixels has {expected} bytes, "
                f"not {self.data.nbytes}."
            )

    def plane_arrays(self) -> tuple[Bytes, ...]:
        """Views of ``data``, one (height, width, channels) uint8 array per plane (no channel axis if there is one)."""
        return split_planes(self.data, self.pixel_format, self.width, self.height)


def split_planes(data: Bytes, pixel_format: PixelFormat, width: int, height: int) -> tuple[Bytes, ...]:
    """Views into flat ``data``: (h, w) per plane of one channel, (h, w, channels) otherwise."""
    views = []
    for plane in planes(pixel_format, width, height):
        flat = data[plane.offset : plane.offset + plane.size_bytes]
        shape = (plane.height, plane.width) if plane.channels == 1 else (plane.height, plane.width, plane.channels)
        views.append(flat.reshape(shape))
    return tuple(views)


def with_alpha(frame: Frame) -> Frame:
    """A packed frame with an opaque alpha channel: gray8 and rgb24 become rgba, bgr24 becomes bgra.

    Raises:
        InvalidFrame: a planar frame.
    """
    if frame.pixel_format.has_alpha:
        return frame
    (pixels, *others) = frame.plane_arrays()
    if others:
        raise InvalidFrame(f"{frame.pixel_format} frames have no room for alpha.")
    opaque = np.empty((frame.height, frame.width, 4), np.uint8)
    opaque[..., :3] = pixels if pixels.ndim == 3 else pixels[..., None]
    opaque[..., 3] = 255
    chosen = PixelFormat.BGRA if frame.pixel_format is PixelFormat.BGR24 else PixelFormat.RGBA
    return Frame(chosen, frame.width, frame.height, opaque.reshape(-1))


@dataclass(frozen=True, slots=True)
class Border:
    """What is painted where the map points outside the source.

    Attributes:
        red, green, blue: 0..255, full range; converted to the frame's own colours by :meth:`samples`.
        alpha: 0..255, used where the format has alpha.

    Raises:
        InvalidOption: a number outside 0..255.
    """

    red: int = 0
    green: int = 0
    blue: int = 0
    alpha: int = 255

    def __post_init__(self) -> None:
        if not all(0 <= value <= 255 for value in (self.red, self.green, self.blue, self.alpha)):
            raise InvalidOption("A border colour is out of range.", allowed="0..255 each")

    @classmethod
    def parse(cls, text: str) -> Border:
        """``black``, ``white``, ``grey``, ``transparent``, or a colour as rrggbb or rrggbbaa in hex, ``#`` optional.

        Raises:
            InvalidOption: anything else.
        """
        named = _NAMED_BORDERS.get(text.lower())
        if named is not None:
            return named
        digits = text.removeprefix("#")
        if not re.fullmatch(_DIGITS, digits):
            raise InvalidOption(f"border={text!r} is not known.", allowed=BORDERS_ALLOWED)
        return cls(*bytes.fromhex(digits))

    def samples(self, pixel_format: PixelFormat) -> tuple[tuple[int, ...], ...]:
        """Sample values, one tuple per plane, one number per channel.

        YUV is BT.601 in video range (ITU-R BT.601-7, section 2.5), the convention of 8-bit i420 and nv12; that of
        ``yuvj420p`` is JFIF's (ITU-T T.871, section 7), in full range.
        """
        r, g, b = self.red, self.green, self.blue
        if pixel_format is PixelFormat.GRAY8:
            return ((round(0.299 * r + 0.587 * g + 0.114 * b),),)
        if pixel_format is PixelFormat.RGB24:
            return ((r, g, b),)
        if pixel_format is PixelFormat.BGR24:
            return ((b, g, r),)
        if pixel_format is PixelFormat.RGBA:
            return ((r, g, b, self.alpha),)
        if pixel_format is PixelFormat.BGRA:
            return ((b, g, r, self.alpha),)
        if pixel_format is PixelFormat.YUVJ420P:
            full = round(0.299 * r + 0.587 * g + 0.114 * b)
            blue = round(128 - 0.168736 * r - 0.331264 * g + 0.5 * b)
            red = round(128 + 0.5 * r - 0.418688 * g - 0.081312 * b)
            return (full,), (min(blue, 255),), (min(red, 255),)
        luma = round(16 + (65.481 * r + 128.553 * g + 24.966 * b) / 255)
        u = round(128 + (-37.797 * r - 74.203 * g + 112.0 * b) / 255)
        v = round(128 + (112.0 * r - 93.786 * g - 18.214 * b) / 255)
        return ((luma,), (u, v)) if pixel_format is PixelFormat.NV12 else ((luma,), (u,), (v,))


BLACK = Border()
TRANSPARENT = Border(alpha=0)
BORDERS_ALLOWED = "black, white, grey, transparent, rrggbb or rrggbbaa in hex"
_NAMED_BORDERS = {
    "black": BLACK,
    "white": Border(255, 255, 255),
    "grey": Border(128, 128, 128),
    "transparent": TRANSPARENT,
}
_DIGITS = "[0-9a-fA-F]{6}(?:[0-9a-fA-F]{2})?"
#: What :meth:`Border.parse` reads, as a regular expression of ECMA 262, which knows no case-insensitive part.
BORDER_PATTERN = f"^(?:{'|'.join(''.join(f'[{c.upper()}{c}]' for c in name) for name in _NAMED_BORDERS)}|#?{_DIGITS})$"
