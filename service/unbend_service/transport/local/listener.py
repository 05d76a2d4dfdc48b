"""The Unix socket over which clients register memory; the frames that lie there are named over gRPC."""

from __future__ import annotations

import asyncio
import os
import socket
import stat
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import structlog
from google.protobuf.message import DecodeError

from unbend.v1 import memory_pb2
from unbend_service.application.regions import Regions
from unbend_service.domain.errors import InvalidOption, InvalidRegion, TooManyRegions, UnbendError

log = structlog.get_logger(__name__)

_LONGEST_REQUEST_BYTES = 4096
_REGIONS_OF_A_CONNECTION = 16
_DESCRIPTORS_OF_A_PACKET = 4
_BACKLOG = 64


@dataclass(slots=True, eq=False)
class _Connection:
    end: socket.socket
    regions: list[str] = field(default_factory=list)


class MemoryListener:
    """Registers the memory of clients; what a connection registered goes when it ends, however it ends.

    Args:
        path: of the socket; made with mode 0600.
        regions: where memory is registered.
        connections: most of them at once; one more is turned away.
    """

    def __init__(self, path: Path, regions: Regions, connections: int) -> None:
        self._path = path
        self._regions = regions
        self._limit = connections
        self._connections: set[_Connection] = set()
        self._socket: socket.socket | None = None
        self._inode = 0

    def start(self) -> None:
        """Listens. Must be called in a running event loop.

        Raises:
            InvalidOption: others could replace the socket, or the path cannot be one.
            OSError: another process listens there.
        """
        check_folder(self._path)
        _remove_stale(self._path)
        listening = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        try:
            listening.bind(str(self._path))
            self._path.chmod(0o600)  # nobody can connect before listen
            listening.listen(_BACKLOG)
        except OSError as error:
            listening.close()
            raise OSError(error.errno, f"Cannot listen on {self._path}: {error.strerror or error}") from error
        self._inode = self._path.stat().st_ino
        self._socket = listening
        asyncio.get_running_loop().add_reader(listening.fileno(), self._accept, listening)

    def close(self) -> None:
        """Ends every connection and removes the socket."""
        if self._socket is None:
            return
        asyncio.get_running_loop().remove_reader(self._socket.fileno())
        self._socket.close()
        self._socket = None
        for connection in list(self._connections):
            self._end(connection)
        with suppress(OSError):
            if self._path.stat().st_ino == self._inode:  # not that of a successor
                self._path.unlink()

    def _accept(self, listening: socket.socket) -> None:
        try:
            end, _ = listening.accept()
        except OSError:  # it went again, or there is no descriptor left for it
            return
        end.setblocking(False)
        if len(self._connections) >= self._limit:
            error = TooManyRegions(f"{self._limit} clients share memory already.", setting="streams")
            _send(end, _refusal(error))
            end.close()
            return
        connection = _Connection(end)
        self._connections.add(connection)
        asyncio.get_running_loop().add_reader(end.fileno(), self._read, connection)

    def _read(self, connection: _Connection) -> None:
        try:
            body, fds, flags, _ = socket.recv_fds(connection.end, _LONGEST_REQUEST_BYTES, _DESCRIPTORS_OF_A_PACKET)
        except BlockingIOError:
            return
        except OSError:
            self._end(connection)
            return
        if not body and not fds:
            self._end(connection)
            return
        truncated = flags & (socket.MSG_TRUNC | socket.MSG_CTRUNC)
        try:
            answer = memory_pb2.RegisterRegionResponse(region_id=self._register(connection, body, fds, bool(truncated)))
        except UnbendError as error:
            log.info("memory refused", code=error.code, message=str(error))
            answer = _refusal(error)
        if not _send(connection.end, answer):
            self._end(connection)

    def _register(self, connection: _Connection, body: bytes, fds: list[int], truncated: bool) -> str:
        """Registers what one packet names; every descriptor that is not kept is closed."""
        try:
            try:
                request = memory_pb2.RegisterRegionRequest.FromString(body)
            except DecodeError:
                raise InvalidRegion("The packet is not a RegisterRegionRequest.") from None
            if truncated or len(fds) != 1:
                raise InvalidRegion(f"{len(fds)} descriptors came with the packet.", allowed="one, of a memfd")
            if len(connection.regions) >= _REGIONS_OF_A_CONNECTION:
                raise TooManyRegions(
                    "The connection has registered too many regions.", allowed=str(_REGIONS_OF_A_CONNECTION)
                )
            self._regions.check_room(request.size_bytes)
        except UnbendError:
            _close_all(fds)
            raise
        region_id = self._regions.register(fds[0], request.size_bytes)
        connection.regions.append(region_id)
        return region_id

    def _end(self, connection: _Connection) -> None:
        if connection not in self._connections:
            return
        self._connections.discard(connection)
        asyncio.get_running_loop().remove_reader(connection.end.fileno())
        connection.end.close()
        for region_id in connection.regions:
            self._regions.release(region_id)


def check_folder(path: Path) -> None:
    """Raises InvalidOption unless only root and this user may put something else at ``path``."""
    folder = path.parent
    try:
        status = folder.stat()
    except OSError as error:
        raise InvalidOption(
            f"The folder {folder} of the local socket cannot be read: {error.strerror}.", setting="local_socket"
        ) from error
    others_write = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH) and not status.st_mode & stat.S_ISVTX
    if not stat.S_ISDIR(status.st_mode) or status.st_uid not in (0, os.geteuid()) or others_write:
        raise InvalidOption(
            f"Others could replace the socket in {folder}.",
            allowed="a folder of this user or of root that others cannot write to, or one with the sticky bit",
            setting="local_socket",
        )


def _remove_stale(path: Path) -> None:
    """Removes the socket that a process left which did not end in order; one that is in use stays and fails to bind."""
    try:
        if not stat.S_ISSOCK(path.lstat().st_mode):
            raise InvalidOption(f"{path} is there and is not a socket.", setting="local_socket")
    except FileNotFoundError:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            path.unlink()
        except OSError:
            return


def _refusal(error: UnbendError) -> memory_pb2.RegisterRegionResponse:
    return memory_pb2.RegisterRegionResponse(
        error=memory_pb2.RegionError(
            code=error.code, message=error.message, allowed=error.allowed or "", setting=error.setting or ""
        )
    )


def _send(end: socket.socket, answer: memory_pb2.RegisterRegionResponse) -> bool:
    """Whether the client takes its answers."""
    try:
        end.send(answer.SerializeToString(), socket.MSG_NOSIGNAL)
    except OSError:
        return False
    return True


def _close_all(fds: list[int]) -> None:
    for fd in fds:
        os.close(fd)
