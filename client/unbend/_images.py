"""Arrays and image files as the bytes of the wire, and back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from unbend._errors import EmptyBody, InvalidFrame, UnsupportedPixelFormat
from unbend._foreign import to_sendable
from unbend._types import Image
from unbend.v1 import frame_pb2

FORMATS: dict[str, frame_pb2.PixelFormat.ValueType] = {
    "gray8": frame_pb2.PIXEL_FORMAT_GRAY8,
    "rgb24": frame_pb2.PIXEL_FORMAT_RGB24,
    "bgr24": frame_pb2.PIXEL_FORMAT_BGR24,
    "rgba": frame_pb2.PIXEL_FORMAT_RGBA,
    "bgra": frame_pb2.PIXEL_FORMAT_BGRA,
    "i420": frame_pb2.PIXEL_FORMAT_I420,
    "nv12": frame_pb2.PIXEL_FORMAT_NV12,
    "jpeg": frame_pb2.PIXEL_FORMAT_JPEG,
    "png": frame_pb2.PIXEL_FORMAT_PNG,
    "webp": frame_pb2.PIXEL_FORMAT_WEBP,
}
ENCODED = ("jpeg", "png", "webp")
_CHANNELS = {"gray8": 1, "rgb24": 3, "bgr24": 3, "rgba": 4, "bgra": 4}
_PLANAR = ("i420", "nv12")


@dataclass(frozen=True, slots=True)
class Packed:
    """A picture ready for the wire.

    Attributes:
        layout: what the bytes are.
        data: the bytes; in streams any contiguous buffer, perhaps that of the caller's array.
        shape: of the array that it was; None if it was bytes.
    """

    layout: frame_pb2.FrameFormat
    data: Any
    shape: tuple[int, ...] | None


def check_format(name: str) -> str:
    """Raises UnsupportedPixelFormat."""
    if name not in FORMATS:
        raise UnsupportedPixelFormat(f"Unknown pixel format {name!r}.", allowed=", ".join(FORMATS))
    return name


def pack(image: Image, pixel_format: str | None = None) -> Packed:
    """One picture of a unary call.

    Raises:
        EmptyBody, InvalidFrame, UnsupportedPixelFormat.
    """
    data, pixel_format = to_sendable(image, pixel_format)
    if isinstance(data, np.ndarray):
        return _pack_array(data, pixel_format)
    if not data:
        raise EmptyBody("There is no image to be sent.")
    if pixel_format is not None and check_format(pixel_format) not in ENCODED:
        raise InvalidFrame(f"Bytes without a size cannot be {pixel_format}.", allowed="an array, or an image file")
    name = pixel_format or _sniff(data)
    return Packed(frame_pb2.FrameFormat(pixel_format=FORMATS[name]), data, None)


def unpack(data: bytes, packed: Packed) -> npt.NDArray[np.uint8] | bytes:
    """The answer to a packed picture: a new array of its shape, or bytes."""
    if packed.shape is None:
        return data
    return np.frombuffer(bytearray(data), np.uint8).reshape(packed.shape)


def frame_size_bytes(pixel_format: str, width: int, height: int) -> int:
    """Bytes of one raw frame; chroma at half resolution, rounded up for odd sizes."""
    if channels := _CHANNELS.get(pixel_format):
        return channels * width * height
    return width * height + 2 * ((width + 1) // 2) * ((height + 1) // 2)


@dataclass(frozen=True, slots=True)
class FrameLayout:
    """What every frame of a stream is.

    Attributes:
        pixel_format: name of a raw or encoded format.
        width, height: pixels; 0 for encoded formats.
    """

    pixel_format: str
    width: int
    height: int

    @classmethod
    def of(cls, pixel_format: str, width: int | None, height: int | None) -> FrameLayout:
        """Raises UnsupportedPixelFormat, or InvalidFrame for a raw format without a size."""
        if check_format(pixel_format) in ENCODED:
            return cls(pixel_format, 0, 0)
        if not width or not height or width < 1 or height < 1:
            raise InvalidFrame(f"A stream of {pixel_format} frames needs their size.", allowed="width and height >= 1")
        return cls(pixel_format, width, height)

    @property
    def message(self) -> frame_pb2.FrameFormat:
        return frame_pb2.FrameFormat(pixel_format=FORMATS[self.pixel_format], width=self.width, height=self.height)

    def pack(self, image: Image) -> Packed:
        """Raises InvalidFrame for an array or bytes that are not of this layout."""
        frame, _ = to_sendable(image, None if self.pixel_format in ENCODED else self.pixel_format)
        shape = tuple(frame.shape) if isinstance(frame, np.ndarray) else None
        if self.pixel_format in ENCODED:
            if isinstance(frame, np.ndarray):
                raise InvalidFrame(f"An array in a stream of {self.pixel_format} files.", allowed="bytes of a file")
            return Packed(self.message, frame, None)
        expected = frame_size_bytes(self.pixel_format, self.width, self.height)
        if isinstance(frame, np.ndarray):
            self._check_array(frame, expected)
        size_bytes = frame.nbytes if isinstance(frame, np.ndarray) else len(frame)
        if size_bytes != expected:
            raise InvalidFrame(
                f"A {self.pixel_format} frame of {self.width}x{self.height} pixels has {expected} bytes, "
                f"not {size_bytes}."
            )
        data = np.ascontiguousarray(frame) if isinstance(frame, np.ndarray) else frame
        return Packed(self.message, data, shape)

    def unpack(self, data: Any, shape: tuple[int, ...] | None) -> npt.NDArray[np.uint8] | bytes:
        """The answer to a frame, a buffer: bytes, or a read-only array of the shape that was sent."""
        if shape is None:
            return bytes(data)
        shown = data if isinstance(data, np.ndarray) else np.frombuffer(data, np.uint8)
        shown = shown.reshape(shape)
        shown.flags.writeable = False
        return shown

    def _check_array(self, frame: np.ndarray, expected: int) -> None:
        if frame.dtype != np.uint8:
            raise InvalidFrame(f"An array of {frame.dtype}.", allowed="uint8")
        flat = (expected,)
        if channels := _CHANNELS.get(self.pixel_format):
            shapes = [flat, (self.height, self.width, channels)]
            if channels == 1:
                shapes.append((self.height, self.width))
        elif self.width % 2 or self.height % 2:
            shapes = [flat]
        else:
            shapes = [flat, (self.height * 3 // 2, self.width)]
        if frame.shape not in shapes:
            raise InvalidFrame(
                f"An array of shape {frame.shape} in a stream of {self.width}x{self.height} {self.pixel_format} "
                "frames.",
                allowed=" or ".join(map(str, shapes)),
            )


def _pack_array(image: np.ndarray, pixel_format: str | None) -> Packed:
    if image.dtype != np.uint8 or image.size == 0:
        raise InvalidFrame(f"An array of {image.dtype} and shape {image.shape}.", allowed="uint8 with at least a pixel")
    channels = 1 if image.ndim == 2 else image.shape[2] if image.ndim == 3 else 0
    name = pixel_format or {1: "gray8", 3: "rgb24", 4: "rgba"}.get(channels)
    if name is None or check_format(name) in ENCODED:
        raise InvalidFrame(
            f"An array of shape {image.shape} as {name or 'a picture'}.",
            allowed="(height, width), (height, width, 3) or (height, width, 4)",
        )
    height, width = image.shape[:2]
    if name in _PLANAR:
        if image.ndim != 2 or height % 3 or width % 2 or height * 2 // 3 % 2:
            raise InvalidFrame(
                f"An array of shape {image.shape} as {name}.", allowed="(height * 3 / 2, width), both even"
            )
        height = height * 2 // 3
    elif channels != _CHANNELS[name]:
        raise InvalidFrame(f"An array of shape {image.shape} as {name}.", allowed=f"(height, width, {_CHANNELS[name]})")
    layout = frame_pb2.FrameFormat(pixel_format=FORMATS[name], width=width, height=height)
    return Packed(layout, image.tobytes(), image.shape)


def _sniff(data: bytes) -> str:
    """The format that an image file is announced as, which is also that of the answer; png if it is another one."""
    if data.startswith(b"\xff\xd8\xff"):
        return "jpeg"
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return "webp"
    return "png"
