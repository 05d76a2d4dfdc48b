"""The render worker: a process that draws the frames it is told of, one after the other.

Run by the pool as ``python -m unbend_service.adapters.renderers.worker FD``, where FD is its end of a socket pair. It
ends when the socket does, and with its parent.
"""

from __future__ import annotations

import ctypes
import faulthandler
import importlib
import signal
import sys
import time

import cv2
import numpy as np

from unbend_service.adapters.renderers.channel import (
    Begin,
    Channel,
    Done,
    Failed,
    FromWorker,
    MapSlot,
    Place,
    Ready,
    Rename,
    Task,
    ToWorker,
    UnmapSlots,
)
from unbend_service.adapters.renderers.slots import Slot
from unbend_service.allocator import REST_S, give_back
from unbend_service.application.ports import Bytes, Renderer
from unbend_service.domain.errors import InvalidInput, RendererUnavailable, RenderFailed, UnbendError
from unbend_service.domain.frames import Frame, frame_size_bytes
from unbend_service.domain.grid import Grid

_PR_SET_PDEATHSIG, _PR_SET_NAME = 1, 15
#: After so many failures in a row the renderer itself is suspect: the worker ends, and the pool starts another.
_FAILURES_IN_A_ROW = 3
_LONGEST_MESSAGE = 2000


class Worker:
    """Serves one channel with one renderer."""

    def __init__(self, channel: Channel, renderer: Renderer) -> None:
        self._channel = channel
        self._renderer = renderer
        self._slots: dict[int, Slot] = {}
        self._grids: dict[str, Grid] = {}
        self._failures = 0
        self._threads = 0

    def serve(self) -> None:
        """Works until the renderer fails again and again.

        Raises:
            RendererUnavailable: it was lost. The frame is not answered, so that another worker draws it.
            EOFError, ConnectionError: the parent has gone.
        """
        while self._failures < _FAILURES_IN_A_ROW:
            message, fd = self._next()
            if isinstance(message, MapSlot) and fd is not None:
                self._slots[message.slot] = Slot(message.slot, fd, message.size_bytes)
            elif isinstance(message, Rename):
                _name(message.name)
            elif isinstance(message, UnmapSlots):
                for number in message.slots:
                    self._slots.pop(number).close()
            elif isinstance(message, Task):
                self._channel.send(self._answer(message))

    def _next(self) -> tuple[FromWorker | ToWorker, int | None]:
        """The next message; if it is long in coming, memory is given back meanwhile."""
        if not self._channel.wait(REST_S):
            self._renderer.rest()
            give_back()
        return self._channel.receive()

    def _answer(self, task: Task) -> Done | Failed:
        started = time.perf_counter()
        try:
            self._render(task)
        except InvalidInput as error:
            return Failed(task.number, error)
        except RendererUnavailable:
            raise
        except Exception as error:
            self._failures += 1
            return Failed(task.number, _as_unbend_error(error))
        self._failures = 0
        return Done(task.number, time.perf_counter() - started)

    def _render(self, task: Task) -> None:
        for grid_id in task.forget:
            self._grids.pop(grid_id, None)
        if task.lattice is not None:
            rows, columns = task.lattice
            lattice = self._part(task.lattice_place, rows * columns * 8)
            self._grids[task.grid_id] = Grid(lattice.view(np.float32).reshape(rows, columns, 2))
        if task.threads != self._threads:
            self._threads = task.threads
            cv2.setNumThreads(task.threads)
        size_bytes = frame_size_bytes(task.pixel_format, task.width, task.height)
        source, target = self._part(task.source, size_bytes), self._part(task.target, size_bytes)
        source.flags.writeable = False
        frame = Frame(task.pixel_format, task.width, task.height, source)
        self._renderer.render(frame, self._grids[task.grid_id], task.border, target)

    def _part(self, place: Place, size_bytes: int) -> Bytes:
        return self._slots[place.slot].memory[place.offset : place.offset + size_bytes]


def _as_unbend_error(error: Exception) -> UnbendError:
    if isinstance(error, UnbendError):
        return error
    return RenderFailed(f"The renderer failed: {type(error).__name__}: {error}"[:_LONGEST_MESSAGE])


def _open(begin: Begin) -> Renderer:
    module, name = begin.factory.split(":")
    renderer: Renderer = getattr(importlib.import_module(module), name)(begin.options)
    return renderer


def _settle(name: str) -> None:
    """Names the process and ties it to its parent; interrupts are left for the parent to decide on."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    faulthandler.enable()
    _name(name)
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)


def _name(name: str) -> None:
    ctypes.CDLL(None).prctl(_PR_SET_NAME, name.encode()[:15], 0, 0, 0)


def main(arguments: list[str]) -> int:
    """Serves the channel whose descriptor is the first argument; the exit status says whether it ended as it should."""
    channel = Channel.from_fd(int(arguments[0]))
    try:
        begin, _ = channel.receive()
        if not isinstance(begin, Begin):
            return 2
        _settle(begin.name)
        return _serve(channel, begin)
    except (EOFError, ConnectionError):
        return 0  # the parent has gone


def _serve(channel: Channel, begin: Begin) -> int:
    try:
        renderer = _open(begin)
    except Exception as error:
        wrapped = RendererUnavailable(f"The renderer cannot start: {type(error).__name__}: {error}"[:_LONGEST_MESSAGE])
        channel.send(Failed(None, error if isinstance(error, UnbendError) else wrapped))
        return 1
    try:
        channel.send(Ready(renderer.info))
        Worker(channel, renderer).serve()
    except RendererUnavailable as error:
        channel.send(Failed(None, error))
        return 1  # what is left of the renderer goes with the process: to free it might hang
    except (EOFError, ConnectionError):
        renderer.close()
        raise
    renderer.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
