"""What the pool and a worker say to each other: small messages over a socket pair, never pixels.

The socket keeps message boundaries (SOCK_SEQPACKET), carries the descriptors of slots, and reads as ended when the
other side dies, after everything that it had sent. Both ends run this very code, so messages are pickled; those of
every frame are tuples, which costs half of what dataclasses would.
"""

from __future__ import annotations

import os
import pickle
import select
import socket
from dataclasses import dataclass
from typing import NamedTuple

from unbend_service.adapters.renderers.selection import RendererOptions
from unbend_service.application.ports import RendererInfo
from unbend_service.domain.errors import UnbendError
from unbend_service.domain.frames import Border, PixelFormat

_LONGEST_BYTES = 64 << 10


@dataclass(frozen=True, slots=True)
class Begin:
    """To a new worker: what to be.

    Attributes:
        name: shown by the system's process list, 15 bytes of it.
        factory: ``module:callable`` that makes the renderer from the options.
    """

    name: str
    factory: str
    options: RendererOptions


@dataclass(frozen=True, slots=True)
class Rename:
    """To a worker: how the system's process list shows it from now on."""

    name: str


@dataclass(frozen=True, slots=True)
class MapSlot:
    """To a worker: map this memory; its descriptor comes with the message."""

    slot: int
    size_bytes: int


@dataclass(frozen=True, slots=True)
class UnmapSlots:
    """To a worker: these slots are gone."""

    slots: tuple[int, ...]


class Place(NamedTuple):
    """Where bytes begin: in which mapped memory, and how far from its start."""

    slot: int
    offset: int


class Task(NamedTuple):
    """To a worker: render one frame.

    Attributes:
        source, target: the frame, and where its answer is to be put; they do not overlap.
        threads: of the processor that the frame may use.
        forget: grids that the worker need not keep any more.
        lattice: (rows, columns) of the float32 lattice; None where the worker has the grid.
        lattice_place: where the lattice begins.
    """

    number: int
    source: Place
    target: Place
    pixel_format: PixelFormat
    width: int
    height: int
    border: Border
    threads: int
    grid_id: str
    lattice: tuple[int, int] | None
    lattice_place: Place
    forget: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Ready:
    """From a worker: it has its renderer."""

    info: RendererInfo


class Done(NamedTuple):
    """From a worker: the target is in the slot."""

    task: int
    render_s: float


@dataclass(frozen=True, slots=True)
class Failed:
    """From a worker: a task could not be done; without a task, it got no renderer or lost it, and ends."""

    task: int | None
    error: UnbendError


ToWorker = Begin | Rename | MapSlot | UnmapSlots | Task
FromWorker = Ready | Done | Failed


class Channel:
    """One end. ``fileno`` is for the event loop."""

    def __init__(self, end: socket.socket) -> None:
        self._socket = end

    @classmethod
    def pair(cls) -> tuple[Channel, Channel]:
        """The parent's end, which does not block, and the worker's."""
        parent, worker = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        parent.setblocking(False)
        return cls(parent), cls(worker)

    @classmethod
    def from_fd(cls, fd: int) -> Channel:
        """The worker's end, inherited."""
        return cls(socket.socket(fileno=fd))

    def fileno(self) -> int:
        return self._socket.fileno()

    def send(self, message: ToWorker | FromWorker, fd: int | None = None) -> None:
        """Raises OSError when the other side is gone, or takes nothing more and this end does not block."""
        body = pickle.dumps(message, pickle.HIGHEST_PROTOCOL)
        if fd is None:
            self._socket.send(body, socket.MSG_NOSIGNAL)
        else:
            socket.send_fds(self._socket, [body], [fd], socket.MSG_NOSIGNAL)

    def receive(self) -> tuple[ToWorker | FromWorker, int | None]:
        """The next message and the descriptor that came with it, owned by the caller.

        Raises:
            EOFError: the other side is gone and everything it sent was received.
            BlockingIOError: nothing there, on the end that does not block.
        """
        try:
            body, fds, flags, _ = socket.recv_fds(self._socket, _LONGEST_BYTES, 1)
        except ConnectionError as error:
            raise EOFError from error
        if not body or flags & socket.MSG_TRUNC:
            for fd in fds:
                os.close(fd)
            raise EOFError
        message: ToWorker | FromWorker = pickle.loads(body)
        return message, fds[0] if fds else None

    def wait(self, patience_s: float) -> bool:
        """Whether a message, or the end, is there within ``patience_s``."""
        poll = select.poll()
        poll.register(self._socket, select.POLLIN)
        return bool(poll.poll(1000 * patience_s))

    def close(self) -> None:
        self._socket.close()
