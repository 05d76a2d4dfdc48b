"""Memory that one connection of a stream shares with a service on the same host."""

from __future__ import annotations

import mmap
import os
import socket
import sys
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import numpy.typing as npt
from google.protobuf.message import DecodeError

from unbend._errors import BY_CODE, InvalidOption, ServerFault, UnbendError, Unreachable
from unbend.v1 import memory_pb2

Bytes = npt.NDArray[np.uint8]

#: Answers that may be held by the caller, beyond those under way, before further ones are copied.
LENT_AT_MOST = 4
_LONGEST_ANSWER_BYTES = 4096


class _Lease:
    """Base of the arrays that show an answer; when the last of them goes, its place is free again."""

    def __init__(self, memory: Bytes, end: Callable[[], None]) -> None:
        self._memory = memory  # keeps the mapping
        self._end = end
        self.__array_interface__ = memory.__array_interface__

    def __del__(self) -> None:
        self._end()


class FrameMemory:
    """Places for the frames of one connection and for their answers, in one region.

    Frames are copied in once; answers are shown where the service put them, for as long as the caller holds them, up to
    LENT_AT_MOST at once. The region is the service's until :meth:`close`, or the end of this process.

    Args:
        path: of the service's local socket.
        frame_bytes: of every frame.
        frames: that may be under way at once.
        timeout_s: for the service to answer.

    Raises:
        InvalidOption: this system has no such memory.
        InvalidRegion, TooManyRegions: the service does not take it.
        Unreachable: nobody listens at ``path``.
    """

    def __init__(self, path: str, frame_bytes: int, frames: int, timeout_s: float) -> None:
        if sys.platform != "linux":
            raise InvalidOption("Memory can be shared on Linux only.", allowed="no shared_memory")
        self.frame_bytes = frame_bytes
        step = -(-frame_bytes // mmap.PAGESIZE) * mmap.PAGESIZE
        self._sources = deque(n * step for n in range(frames))
        self._targets = deque((frames + n) * step for n in range(frames + LENT_AT_MOST))
        self._lent: set[int] = set()
        size_bytes = (2 * frames + LENT_AT_MOST) * step
        fd = _sealed_memory(size_bytes)
        try:
            self._memory: Bytes = np.frombuffer(mmap.mmap(fd, size_bytes), np.uint8)
            self._socket, self.region_id = _register(path, fd, size_bytes, timeout_s)
        finally:
            os.close(fd)

    def put(self, frame: Any) -> memory_pb2.SharedPicture:
        """Copies a frame, contiguous bytes, into a free place, and takes one for its answer.

        There is room for as many frames as were announced, counted until :meth:`free`.
        """
        source, target = self._sources.popleft(), self._targets.popleft()
        self._memory[source : source + self.frame_bytes] = np.frombuffer(frame, np.uint8)
        return memory_pb2.SharedPicture(
            region_id=self.region_id, source_offset=source, target_offset=target, size_bytes=self.frame_bytes
        )

    def source(self, places: memory_pb2.SharedPicture) -> Bytes:
        """The frame that was put there."""
        return self._memory[places.source_offset : places.source_offset + self.frame_bytes]

    def take(self, places: memory_pb2.SharedPicture) -> Bytes:
        """The answer to a frame, (frame_bytes,) uint8; its places are free when nobody looks at it any more."""
        self._sources.append(places.source_offset)
        offset = places.target_offset
        answer = self._memory[offset : offset + self.frame_bytes]
        if len(self._lent) >= LENT_AT_MOST:
            answer = answer.copy()
            self._targets.append(offset)
            return answer
        self._lent.add(offset)
        lent, targets = self._lent, self._targets

        def give_back() -> None:  # in whatever thread; knows nothing of the connection, which may be gone
            targets.append(offset)
            lent.discard(offset)

        return np.asarray(_Lease(answer, give_back))

    def free(self, places: memory_pb2.SharedPicture) -> None:
        """Nobody wants the answer: a frame that was dropped or failed."""
        self._sources.append(places.source_offset)
        self._targets.append(places.target_offset)

    def close(self) -> None:
        """Takes the memory back; answers that are still held stay as they are."""
        self._socket.close()


def _sealed_memory(size_bytes: int) -> int:
    """A descriptor of new memory that can never shrink, which the service insists on."""
    import fcntl  # not on every system that the client runs on

    fd = os.memfd_create("unbend-frames", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    try:
        os.ftruncate(fd, size_bytes)
        fcntl.fcntl(fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL)
    except BaseException:
        os.close(fd)
        raise
    return fd


def _register(path: str, fd: int, size_bytes: int, timeout_s: float) -> tuple[socket.socket, str]:
    """The connection that keeps the region alive, and the region's id."""
    end = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        end.settimeout(timeout_s)
        end.connect(path)
        request = memory_pb2.RegisterRegionRequest(size_bytes=size_bytes)
        with suppress(BrokenPipeError):  # it turned the connection away, and its answer says why
            socket.send_fds(end, [request.SerializeToString()], [fd])
        answer = memory_pb2.RegisterRegionResponse.FromString(end.recv(_LONGEST_ANSWER_BYTES))
        if answer.WhichOneof("result") == "error":
            error = answer.error
            raise BY_CODE.get(error.code, UnbendError)(
                error.message, allowed=error.allowed or None, setting=error.setting or None
            )
        if not answer.region_id:
            raise Unreachable(f"The service closed the connection at {path}.")
    except BaseException as error:
        end.close()
        if isinstance(error, DecodeError):
            raise ServerFault("The local socket does not speak unbend.v1.") from error
        if isinstance(error, OSError) and not isinstance(error, UnbendError):
            reason = error.strerror or str(error) or type(error).__name__
            raise Unreachable(f"No memory can be shared at {path}: {reason}.") from error
        raise
    return end, answer.region_id
