"""Pictures of Pillow and PyAV, recognised by what they can do: neither library is imported to look at them."""

from __future__ import annotations

import importlib
import io
from pathlib import PurePath
from typing import Any

import numpy as np
import numpy.typing as npt

from unbend._colours import read_rgb
from unbend._errors import InvalidFrame, MissingPackage

Bytes = npt.NDArray[np.uint8]

_TAKEN = "a uint8 array, the bytes of an image file, a Pillow image or a PyAV frame"
#: PyAV's names of pixel formats -> ours, for those whose bytes are the same.
_OF_PYAV = {
    "gray": "gray8",
    "rgb24": "rgb24",
    "bgr24": "bgr24",
    "rgba": "rgba",
    "bgra": "bgra",
    "yuv420p": "i420",
    "yuvj420p": "i420",
    "nv12": "nv12",
}
_TO_PYAV = {ours: theirs for theirs, ours in reversed(_OF_PYAV.items())}
_PLANAR = ("i420", "nv12")
_OF_PILLOW = {"L": "gray8", "RGB": "rgb24", "RGBA": "rgba"}
_TO_PILLOW = {ours: theirs for theirs, ours in _OF_PILLOW.items()}
_DEEP = ("I", "F")


def is_pillow(image: object) -> bool:
    """Whether it does what a ``PIL.Image.Image`` does."""
    return all(hasattr(image, name) for name in ("mode", "size", "convert", "tobytes"))


def is_pyav(image: object) -> bool:
    """Whether it does what an ``av.VideoFrame`` does."""
    return all(hasattr(image, name) for name in ("planes", "to_ndarray", "reformat", "format"))


def to_sendable(image: Any, pixel_format: str | None = None) -> tuple[Bytes | bytes, str | None]:
    """Any picture as an array or as bytes, and the pixel format that it is in.

    Args:
        image: what :data:`unbend.Image` allows.
        pixel_format: into which a Pillow image or a PyAV frame is converted; None: the nearest that loses nothing but
            depth. For an array it says what the array is and is handed through.

    Raises:
        InvalidFrame: something that is no picture, or one of more than 8 bits.
    """
    if isinstance(image, np.ndarray):
        return image, pixel_format
    if isinstance(image, bytes | bytearray | memoryview):
        return bytes(image), pixel_format
    if is_pyav(image):
        return _from_pyav(image, pixel_format)
    if is_pillow(image):
        return _from_pillow(image, pixel_format)
    if hasattr(image, "__array__") or hasattr(image, "__array_interface__"):
        return np.asarray(image), pixel_format
    hint = "; read a file with path.read_bytes()" if isinstance(image, str | PurePath) else ""
    raise InvalidFrame(f"A {type(image).__name__} is no picture.", allowed=_TAKEN + hint)


def timestamp_us_of(image: object) -> int:
    """Presentation time of a PyAV frame in microseconds; 0 for everything else."""
    time_s = getattr(image, "time", None) if is_pyav(image) else None
    return 0 if time_s is None else round(time_s * 1_000_000)


def to_pil(image: Bytes | bytes, pixel_format: str, width: int, height: int) -> Any:
    """A ``PIL.Image.Image``: the file opened, gray8 as L, rgba and bgra as RGBA, everything else as RGB.

    Raises:
        MissingPackage: Pillow is not installed.
    """
    pillow = _load("PIL.Image", "A Pillow image", "pip install pillow")
    if isinstance(image, bytes):
        return pillow.open(io.BytesIO(image))
    if pixel_format in _TO_PILLOW:
        shape = (height, width) if pixel_format == "gray8" else (height, width, -1)
        return pillow.fromarray(image.reshape(shape))
    if pixel_format == "bgra":
        return pillow.fromarray(np.ascontiguousarray(image.reshape(height, width, 4)[..., [2, 1, 0, 3]]))
    return pillow.fromarray(read_rgb(image, pixel_format, width, height))


def to_av(image: Bytes | bytes, pixel_format: str, width: int, height: int) -> Any:
    """An ``av.VideoFrame`` in the same pixel format; the bytes of a file become rgb24.

    Raises:
        MissingPackage: PyAV, or for a file Pillow, is not installed.
        InvalidFrame: chroma of an odd size, which PyAV does not take from an array.
    """
    frames = _load("av", "A PyAV frame", "pip install 'unbend[video]'")
    if isinstance(image, bytes):
        return frames.VideoFrame.from_image(to_pil(image, pixel_format, width, height).convert("RGB"))
    if pixel_format in _PLANAR:
        if width % 2 or height % 2:
            raise InvalidFrame(f"PyAV takes no {pixel_format} array of {width}x{height} pixels.", allowed="even sizes")
        image = image.reshape(height * 3 // 2, width)
    elif pixel_format == "gray8":
        image = image.reshape(height, width)
    else:
        image = image.reshape(height, width, -1)
    return frames.VideoFrame.from_ndarray(np.ascontiguousarray(image), format=_TO_PYAV[pixel_format])


def _from_pillow(image: Any, pixel_format: str | None) -> tuple[Bytes, str]:
    """As it lies in memory: ``ImageOps.exif_transpose`` turns it upright, where that is wanted, beforehand."""
    if image.mode.startswith(_DEEP):
        raise InvalidFrame(
            f"A Pillow image of mode {image.mode} has more than 8 bits a channel.", allowed="image.convert('RGB')"
        )
    if image.mode in _OF_PILLOW:
        mode = image.mode
    elif "A" in image.mode.replace("LAB", "") or "a" in image.mode or "transparency" in image.info:
        mode = "RGBA"
    else:
        mode = "L" if image.mode == "1" else "RGB"
    if pixel_format is not None:
        mode = {"gray8": "L", "rgba": "RGBA", "bgra": "RGBA"}.get(pixel_format, "RGB")
        if pixel_format in _PLANAR:
            raise InvalidFrame(f"A Pillow image cannot be sent as {pixel_format}.", allowed="gray8, rgb24, rgba, ...")
    array = np.asarray(image if image.mode == mode else image.convert(mode), dtype=np.uint8)
    if pixel_format == "bgr24":
        return array[..., ::-1], pixel_format
    if pixel_format == "bgra":
        return array[..., [2, 1, 0, 3]], pixel_format
    return array, pixel_format or _OF_PILLOW[mode]


def _from_pyav(frame: Any, pixel_format: str | None) -> tuple[Bytes, str]:
    name = pixel_format or _OF_PYAV.get(frame.format.name, "rgb24")
    if name not in _TO_PYAV:
        raise InvalidFrame(f"A PyAV frame cannot be sent as {name}.", allowed=", ".join(_TO_PYAV))
    odd = frame.width % 2 or frame.height % 2
    if odd and name in _PLANAR and pixel_format is None:
        name = "rgb24"  # an array of a call cannot say where its chroma begins if the size is odd
    if _OF_PYAV.get(frame.format.name) != name:
        frame = frame.reformat(format=_TO_PYAV[name])
    if name not in _PLANAR:
        return np.asarray(frame.to_ndarray(), dtype=np.uint8), name
    flat = np.concatenate([_plane(plane, index, name) for index, plane in enumerate(frame.planes)])
    return (flat if odd else flat.reshape(frame.height * 3 // 2, frame.width)), name


def _plane(plane: Any, index: int, pixel_format: str) -> Bytes:
    """The samples of a plane, flat, without what pads its rows."""
    row_bytes = plane.width * (2 if pixel_format == "nv12" and index else 1)
    rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)
    return rows[: plane.height, :row_bytes].ravel()


def _load(module: str, purpose: str, remedy: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingPackage(f"{purpose} needs a package that is not installed.", allowed=remedy) from error
