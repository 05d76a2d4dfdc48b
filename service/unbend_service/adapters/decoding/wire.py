"""What the service and a decoder say to each other: short JSON messages over a socket pair, never pixels.

The service believes nothing that a decoder says: a decoder may have been taken over by what it decoded. Hence JSON
instead of pickles, memory that the service owns and whose size nobody can change, and checks of every number.
"""

from __future__ import annotations

import os
import socket
from typing import Any

import orjson

_LONGEST_BYTES = 64 << 10


class Wire:
    """One end. Keeps message boundaries (SOCK_SEQPACKET), and may carry one descriptor with a message."""

    def __init__(self, end: socket.socket) -> None:
        self._socket = end

    @classmethod
    def pair(cls) -> tuple[Wire, Wire]:
        """The service's end and the decoder's."""
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        return cls(ours), cls(theirs)

    @classmethod
    def from_fd(cls, fd: int) -> Wire:
        """The decoder's end, inherited."""
        return cls(socket.socket(fileno=fd))

    def fileno(self) -> int:
        return self._socket.fileno()

    def send(self, message: dict[str, Any], fd: int | None = None) -> None:
        """Raises OSError when the other side is gone."""
        body = orjson.dumps(message)
        if fd is None:
            self._socket.send(body, socket.MSG_NOSIGNAL)
        else:
            socket.send_fds(self._socket, [body], [fd], socket.MSG_NOSIGNAL)

    def receive(self, patience_s: float | None = None) -> tuple[dict[str, Any], int | None]:
        """The next message and the descriptor that came with it, owned by the caller.

        Raises:
            EOFError: the other side is gone, or does not speak this language.
            TimeoutError: nothing came within ``patience_s``.
        """
        self._socket.settimeout(patience_s)
        try:
            body, fds, flags, _ = socket.recv_fds(self._socket, _LONGEST_BYTES, 1)
        except ConnectionError as error:
            raise EOFError from error
        fd = fds[0] if fds else None
        try:
            if not body or flags & socket.MSG_TRUNC:
                raise EOFError
            message = orjson.loads(body)
            if not isinstance(message, dict):
                raise EOFError
        except (EOFError, orjson.JSONDecodeError) as error:
            if fd is not None:
                os.close(fd)
            raise EOFError from error
        return message, fd

    def close(self) -> None:
        self._socket.close()
