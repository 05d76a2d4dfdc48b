"""The decoder: a process that opens one file after the other for the service.

Run as ``python -m unbend_service.adapters.decoding.decoder FD``, where FD is its end of a socket pair. It ends when
the socket does, and with its parent. Its memory is limited, it can write no file, and the environment that it gets
holds no setting of the service.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import resource
import signal
import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from unbend_service.adapters.codecs.pillow import PillowCodec
from unbend_service.adapters.decoding.wire import Wire
from unbend_service.allocator import REST_S, give_back
from unbend_service.application.ports import Bytes
from unbend_service.domain.cameras import Camera
from unbend_service.domain.dense_maps import PixelMap
from unbend_service.domain.errors import ImageTooCostly, InvalidImage, UnbendError
from unbend_service.domain.exchange import ImportFormat

_PR_SET_PDEATHSIG, _PR_SET_NAME, _PR_SET_NO_NEW_PRIVS = 1, 15, 38
_LONGEST_MESSAGE = 1000
_DESCRIPTORS = 64

Answer = dict[str, Any]


class _RefusedError(Exception):
    """The service gives no memory for this file; why, it says itself."""


class Decoder:
    """Serves one wire."""

    def __init__(self, wire: Wire, source_pixels: int, animation_frames: int) -> None:
        self._wire = wire
        self._codec = PillowCodec(SimpleNamespace(source_pixels=source_pixels, animation_frames=animation_frames))
        self._works: dict[str, Callable[[bytes, Answer], Answer]] = {
            "probe": self._probe,
            "origin": self._origin,
            "decode": self._decode,
            "grey": self._grey,
            "map": self._map,
        }

    def serve(self) -> None:
        """Works until it ran out of memory; raises EOFError or OSError when the parent goes."""
        exhausted = False
        while not exhausted:
            request, fd = self._next()
            if fd is None:
                raise EOFError
            try:
                body = bytes(_mapped(fd, request["size"]))
                answer: Answer = {"done": self._works[request["work"]](body, request)}
            except MemoryError:
                exhausted = True  # what is left is in pieces
                answer = _failure(ImageTooCostly("Decoding the file takes more memory than is granted."))
            except UnbendError as error:
                answer = _failure(error)
                exhausted = isinstance(error, ImageTooCostly)
            except OSError:
                raise
            except Exception as error:
                answer = _failure(InvalidImage(f"The file cannot be read: {type(error).__name__}."))
            answer["last"] = exhausted
            self._wire.send(answer)

    def _next(self) -> tuple[Answer, int | None]:
        """The next request; if it is long in coming, memory is given back meanwhile."""
        try:
            return self._wire.receive(REST_S)
        except TimeoutError:
            give_back()
            return self._wire.receive()

    def _probe(self, body: bytes, request: Answer) -> Answer:
        header = self._codec.probe(body)
        return {"width": header.width, "height": header.height, "alpha": header.has_alpha}

    def _origin(self, body: bytes, request: Answer) -> Answer:
        origin = self._codec.origin(body)
        return {"aspect": float(origin.aspect), "camera": origin.camera}

    def _decode(self, body: bytes, request: Answer) -> Answer:
        placed: list[Bytes] = []

        def place(size_bytes: int) -> Bytes:
            placed.append(self._memory(size_bytes))
            return placed[-1]

        image = self._codec.decode(body, request["planes"], place)
        frame = image.frame
        if not placed or placed[-1].size != frame.data.size:
            place(frame.data.size)
        if not np.shares_memory(frame.data, placed[-1]):
            np.copyto(placed[-1], frame.data)
        part = len(placed) - 1
        kept = (image.exif or b"") + (image.icc_profile or b"")
        if kept:
            self._place(np.frombuffer(kept, np.uint8))
        return {
            "part": part,
            "pixel_format": frame.pixel_format.value,
            "width": frame.width,
            "height": frame.height,
            "upright": image.upright,
            "chroma": image.chroma_subsampling,
            "exif": None if image.exif is None else len(image.exif),
            "icc": None if image.icc_profile is None else len(image.icc_profile),
        }

    def _grey(self, body: bytes, request: Answer) -> Answer:
        grey = self._codec.decode_grey(body, request["longest_px"])
        self._place(grey.reshape(-1))
        return {"width": grey.shape[1], "height": grey.shape[0]}

    def _map(self, body: bytes, request: Answer) -> Answer:
        from unbend_service.adapters.exchange.files import ExchangeFiles  # seldom needed, and slow to load

        read = ExchangeFiles().read_map(ImportFormat(request["kind"]), body)
        if isinstance(read, Camera):
            matrix = [float(number) for number in read.matrix.reshape(-1)]
            return {
                "camera": [*matrix, *read.coefficients],
                "fisheye": read.fisheye,
                "width": read.width,
                "height": read.height,
            }
        if not isinstance(read, PixelMap):
            raise InvalidImage("The file holds no map.")
        map_x, map_y = read.maps
        memory = self._memory(8 * map_x.size).view(np.float32).reshape(2, *map_x.shape)
        memory[0], memory[1] = map_x, map_y
        return {"width": map_x.shape[1], "height": map_x.shape[0]}

    def _place(self, data: Bytes) -> None:
        np.copyto(self._memory(data.size), data)

    def _memory(self, size_bytes: int) -> Bytes:
        """(size_bytes,) uint8, writable, which the service sees too."""
        self._wire.send({"need": size_bytes})
        granted, fd = self._wire.receive()
        if fd is None:
            raise _RefusedError
        return np.frombuffer(_mapped(fd, granted["size"]), np.uint8)[:size_bytes]


def _mapped(fd: int, size_bytes: int) -> memoryview:
    """The memory behind a descriptor, which is closed here."""
    try:
        return memoryview(mmap.mmap(fd, size_bytes, flags=mmap.MAP_SHARED | mmap.MAP_POPULATE))
    except OSError as error:
        raise MemoryError from error
    finally:
        os.close(fd)


def _failure(error: UnbendError) -> Answer:
    return {
        "error": error.code,
        "message": error.message[:_LONGEST_MESSAGE].encode(errors="replace").decode(),
        "allowed": error.allowed,
        "setting": error.setting,
    }


def _settle(memory_bytes: int) -> None:
    """Gives up what a decoder does not need."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_PR_SET_NAME, b"unbend-decode", 0, 0, 0)
    libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
    with open("/proc/self/statm") as statm:
        start_bytes = int(statm.read().split()[0]) * resource.getpagesize()
    for limit, most in (
        (resource.RLIMIT_AS, start_bytes + memory_bytes),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_NOFILE, _DESCRIPTORS),
    ):
        _, hard = resource.getrlimit(limit)
        if hard != resource.RLIM_INFINITY:
            most = min(most, hard)
        resource.setrlimit(limit, (most, most))


def main(arguments: list[str]) -> int:
    """Serves the wire whose descriptor is the first argument."""
    wire = Wire.from_fd(int(arguments[0]))
    try:
        begin, _ = wire.receive()
        decoder = Decoder(wire, begin["source_pixels"], begin["animation_frames"])
        _settle(begin["memory_bytes"])
        wire.send({"ready": True})
        decoder.serve()
    except (EOFError, OSError):
        pass  # the parent has gone
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
