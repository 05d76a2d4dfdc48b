"""The planes of a 4:2:0 JPEG as they are stored, by the TurboJPEG library of the system, if it has one.

simplejpeg encodes planes but decodes none, and bindings that do want a newer libjpeg-turbo than Debian 12 has, or copy
what they decode. The five functions used here are those of TurboJPEG 1.4 to 3.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from ctypes import CDLL, POINTER, byref, c_char_p, c_int, c_ulong, c_void_p

import numpy as np

from unbend_service.application.ports import Bytes
from unbend_service.domain.frames import PixelFormat, frame_size_bytes, split_planes

LIBRARY = "libturbojpeg.so.0"
_SUBSAMPLED_420, _YCBCR = 2, 1
#: Of the inverse cosine transform, as simplejpeg has it.
_ACCURATE = 4096


class PlanarJpegs:
    """Decodes into planes; thread-safe. Without the library nothing is decoded.

    Args:
        library: its name; None: as Debian and most others call it.
    """

    def __init__(self, library: str | None = None) -> None:
        self._library = _loaded(library or LIBRARY)
        self._local = threading.local()

    @property
    def available(self) -> bool:
        """Whether the system has the library."""
        return self._library is not None

    def decode(self, body: bytes, size: tuple[int, int], place: Callable[[int], Bytes] | None = None) -> Bytes | None:
        """The samples of a file as a yuvj420p frame, (frame_size_bytes,) uint8, not turned.

        Args:
            size: width and height, which were checked.
            place: gives the (n,) uint8 memory to decode into.

        Returns:
            None without the library, for a file of another size or not YCbCr at 4:2:0, and for one that is not read
            to its last byte without a warning: another decoder says better what is wrong with it.
        """
        if self._library is None:
            return None
        handle = self._handle(self._library)
        width, height, subsampling, space = c_int(), c_int(), c_int(), c_int()
        length = c_ulong(len(body))
        said = map(byref, (width, height, subsampling, space))
        if self._library.tjDecompressHeader3(handle, body, length, *said):
            return None
        if (width.value, height.value, subsampling.value, space.value) != (*size, _SUBSAMPLED_420, _YCBCR):
            return None
        size_bytes = frame_size_bytes(PixelFormat.YUVJ420P, *size)
        data = np.empty(size_bytes, np.uint8) if place is None else place(size_bytes)
        planes = split_planes(data, PixelFormat.YUVJ420P, *size)
        targets = (c_void_p * 3)(*(plane.ctypes.data for plane in planes))
        failed = self._library.tjDecompressToYUVPlanes(handle, body, length, targets, 0, None, 0, _ACCURATE)
        return None if failed else data

    def _handle(self, library: CDLL) -> c_void_p:
        """One a thread: it serves one file at a time."""
        held = getattr(self._local, "handle", None)
        if held is None:
            held = self._local.handle = _Handle(library)
        return held.pointer


class _Handle:
    """A decompressor; freed with its thread."""

    def __init__(self, library: CDLL) -> None:
        self._library = library
        self.pointer = c_void_p(library.tjInitDecompress())
        if not self.pointer:
            raise MemoryError

    def __del__(self) -> None:
        if self.pointer:
            self._library.tjDestroy(self.pointer)


def _loaded(name: str) -> CDLL | None:
    try:
        library = CDLL(name)
        library.tjInitDecompress.restype = c_void_p
        library.tjInitDecompress.argtypes = []
        library.tjDestroy.argtypes = [c_void_p]
        numbers = POINTER(c_int)
        library.tjDecompressHeader3.argtypes = [c_void_p, c_char_p, c_ulong, numbers, numbers, numbers, numbers]
        library.tjDecompressToYUVPlanes.argtypes = [
            c_void_p, c_char_p, c_ulong, c_void_p * 3, c_int, POINTER(c_int), c_int, c_int,
        ]  # fmt: skip
    except (OSError, AttributeError):  # not there, or not what its name says
        return None
    return library
