"""``Stream``: frames in, corrected frames out, in the thread of the caller."""

from __future__ import annotations

import queue
import time
from collections.abc import Iterable, Iterator
from types import TracebackType

import grpc

from unbend import _types as types
from unbend._channel import Metadata
from unbend._connection import Connection, Event
from unbend._errors import Closed, DeadlineExceeded, ServerFault, TooManyRegions, Unavailable, UnbendError
from unbend._images import FrameLayout
from unbend._memory import FrameMemory
from unbend._stream_core import StreamCore, StreamOptions, split


class Stream:
    """One stream of frames; made by :meth:`unbend.Client.stream`, used in a ``with`` block, by one thread.

    If the connection breaks, the stream is opened again under its id and the frames that were not answered are sent
    again: the caller sees each frame answered once and in order.

    >>> frames = (np.full((48, 64), level, np.uint8) for level in range(3))
    >>> with client.stream(64, 48, "gray8", stream_id="door-camera") as stream:
    ...     print([result.index for result in stream.correct(frames)])
    [0, 1, 2]
    >>> with client.stream(64, 48, "gray8", stream_id="door-camera") as stream:
    ...     stream.resumed
    True
    """

    def __init__(
        self,
        channel: grpc.Channel,
        metadata: Metadata,
        layout: FrameLayout,
        options: StreamOptions,
        timeout_s: float,
        shared_memory: str | None = None,
    ) -> None:
        self._channel = channel
        self._metadata = metadata
        self._timeout_s = timeout_s
        self._shared_memory = shared_memory
        self._memory: FrameMemory | None = None
        self._core = StreamCore(layout, options)
        self._inbox: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._connection: Connection | None = None
        self._finishing = False
        self._closed = False

    @property
    def stream_id(self) -> str:
        """Under which the stream can be opened again; known once it is open."""
        return self._core.stream_id

    @property
    def grid(self) -> types.GridRecord | None:
        """The grid of the stream, before fit and strength; None until it is fixed."""
        return self._core.grid

    @property
    def resumed(self) -> bool:
        """Whether the server knew the stream id and reuses its grid."""
        return self._core.resumed

    def __enter__(self) -> Stream:
        try:
            self._connect()
            while not self._core.opened:
                for _ in self._results():
                    raise ServerFault("The server answered before the stream was open.")
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def correct(self, frames: Iterable[types.Image | tuple[types.Image, int]]) -> Iterator[types.StreamResult]:
        """Answers ``frames``, in their order, each exactly once.

        The frames are drawn from the iterable in the thread of the caller, a bounded number ahead of the answers;
        answers that are there are given before the next frame is drawn.

        Args:
            frames: arrays, or bytes of image files, as the stream was opened for; Pillow images and PyAV frames, which
                are converted to its pixel format; or pairs of one and its presentation time in microseconds, which a
                PyAV frame brings with it.

        Raises:
            InvalidFrame: a frame that is not of the stream's layout.
            DeadlineExceeded: no answer within ``timeout_s`` of the client.
            StreamTakenOver: another connection opened the stream id.
            Unavailable: the server is gone and stayed so.
            Closed: the stream was closed.
        """
        if self._closed:
            raise Closed("The stream was closed.")
        if self._core.is_waiting:  # an iteration before this one was given up
            self._disconnect()
            self._core.forget()
        for item in frames:
            while not self._core.has_room:
                yield from self._results()
            self._send(*split(item))
            yield from self._results_there()
        if self._core.is_waiting and self._core.grid is None:
            self._finish()  # so that the grid is not waited for: there are no further frames for it
        while self._core.is_waiting:
            yield from self._results()
        if self._finishing and self._connection is not None:
            self._connection.join()
            self._disconnect()

    def close(self) -> None:
        """Ends the stream; frames that are not answered are given up. The server remembers the grid."""
        if self._closed:
            return
        self._closed = True
        if self._connection is not None and self._core.opened and not self._core.is_waiting:
            self._connection.finish()
            self._connection.join()
        self._disconnect()

    def _connect(self) -> None:
        inbox: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._inbox = inbox
        if self._shared_memory is not None:
            try:
                self._memory = self._core.new_memory(self._shared_memory, self._timeout_s)
            except (TooManyRegions, Unavailable) as error:  # later it may do
                inbox.put(error)
                return
        self._connection = Connection(self._channel, self._metadata, inbox.put)
        for request in self._core.first(self._memory):
            self._connection.send(request)
        if self._finishing:
            self._connection.finish()

    def _disconnect(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection.join()
            self._connection = None
        if self._memory is not None:
            self._memory.close()
            self._memory = None
        self._finishing = False

    def _finish(self) -> None:
        self._finishing = True
        if self._connection is not None:
            self._connection.finish()

    def _send(self, image: types.Image, timestamp_us: int) -> None:
        request = self._core.accept(image, timestamp_us)
        if self._connection is None:
            self._connect()
        else:
            self._connection.send(request)

    def _results(self) -> Iterator[types.StreamResult]:
        """Waits for the next event and gives the result that it is, if it is one."""
        if self._closed:
            raise Closed("The stream was closed.")
        try:
            event = self._inbox.get(timeout=self._timeout_s)
        except queue.Empty:
            raise DeadlineExceeded(f"The server did not answer within {self._timeout_s:g} s.") from None
        yield from self._handle(event)

    def _results_there(self) -> Iterator[types.StreamResult]:
        """The results that have come already."""
        while self._connection is not None and not self._inbox.empty():
            yield from self._handle(self._inbox.get_nowait())

    def _handle(self, event: Event) -> Iterator[types.StreamResult]:
        if event is None or isinstance(event, UnbendError):
            self._reconnect(event)
        elif (result := self._core.receive(event)) is not None:
            yield result

    def _reconnect(self, error: UnbendError | None) -> None:
        finishing = self._finishing
        self._disconnect()
        pause_s = self._core.lost(error)
        if self._core.is_waiting or not self._core.opened:
            time.sleep(pause_s)
            self._finishing = finishing
            self._connect()
