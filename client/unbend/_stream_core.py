"""One stream without its input and output: what may be sent, what was answered, what is sent again.

The caller feeds in frames and responses and carries out what it is told; see ``Stream`` and ``AsyncStream``.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

from unbend import _types as types
from unbend._calls import from_record, to_correct, to_guides, to_rendering
from unbend._errors import (
    InvalidOption,
    ServerFault,
    StreamIdle,
    TooManyRegions,
    TooManyStreams,
    Unavailable,
    UnbendError,
)
from unbend._failures import of_frame
from unbend._foreign import timestamp_us_of
from unbend._images import ENCODED, FrameLayout, frame_size_bytes
from unbend._memory import FrameMemory
from unbend._retries import backoff_s
from unbend._wire import FRAME_DATA_FIELD, FRAME_FIELD, RESULT_DATA_FIELD, RESULT_FIELD, attach, detach
from unbend.v1 import correction_pb2, memory_pb2

Request = correction_pb2.CorrectStreamRequest
Response = correction_pb2.CorrectStreamResponse


@dataclass(frozen=True, slots=True)
class FrameAnswer:
    """A result, and its picture where it lies in the message."""

    result: correction_pb2.StreamResult
    data: memoryview | bytes


#: What the server says.
Answer = Response | FrameAnswer

WHILE_ESTIMATING = {
    "hold": correction_pb2.WHILE_ESTIMATING_HOLD,
    "pass_through": correction_pb2.WHILE_ESTIMATING_PASS_THROUGH,
}
DELIVERIES = {"lossless": correction_pb2.DELIVERY_LOSSLESS, "latest": correction_pb2.DELIVERY_LATEST}
STATUSES = {
    correction_pb2.FRAME_STATUS_CORRECTED: types.FrameStatus.CORRECTED,
    correction_pb2.FRAME_STATUS_PASSED_THROUGH: types.FrameStatus.PASSED_THROUGH,
    correction_pb2.FRAME_STATUS_DROPPED: types.FrameStatus.DROPPED,
    correction_pb2.FRAME_STATUS_FAILED: types.FrameStatus.FAILED,
}
#: Before the server has ever answered it is not a broken stream that has to be mended, but perhaps a wrong address.
_ATTEMPTS_TO_OPEN = 3
_LONGEST_DEADLINE_S = 86_400


@dataclass(frozen=True, slots=True)
class StreamOptions:
    """As :meth:`unbend.Client.stream` takes them."""

    stream_id: str | None = None
    correct: str = "nonlinear"
    fit: str | float = "crop"
    strength: float = 1.0
    border: types.Border | None = None
    quality: int | None = None
    grid: str | types.GridRecord | types.Estimate | types.Guides | None = None
    frames: int | None = None
    while_estimating: str = "hold"
    delivery: str = "lossless"
    min_confidence: float | None = None
    estimate_again: bool = False
    in_flight: int = 8
    reconnects: int = 8
    frame_deadline_s: float | None = None

    def opening(self, layout: FrameLayout) -> correction_pb2.StreamOpen:
        """The first message of the stream. Raises InvalidOption."""
        for name, value, known in (
            ("while_estimating", self.while_estimating, WHILE_ESTIMATING),
            ("delivery", self.delivery, DELIVERIES),
        ):
            if value not in known:
                raise InvalidOption(f"{name}={value!r} is not known.", allowed=", ".join(known))
        if self.in_flight < 1:
            raise InvalidOption(f"in_flight={self.in_flight} is out of range.", allowed="1 and more")
        if self.frame_deadline_s is not None and not 0.001 <= self.frame_deadline_s <= _LONGEST_DEADLINE_S:
            raise InvalidOption(
                f"frame_deadline_s={self.frame_deadline_s} is out of range.", allowed=f"0.001..{_LONGEST_DEADLINE_S}"
            )
        if self.frames is not None and not 1 <= self.frames <= 64:
            raise InvalidOption(f"frames={self.frames} is out of range.", allowed="1..64")
        message = correction_pb2.StreamOpen(
            stream_id=self.stream_id or "",
            format=layout.message,
            correct=to_correct(self.correct),
            rendering=to_rendering(self.fit, self.strength, self.border, self.quality),
            while_estimating=WHILE_ESTIMATING[self.while_estimating],
            delivery=DELIVERIES[self.delivery],
            min_confidence=self.min_confidence,
            estimate_again=self.estimate_again,
        )
        match self.grid:
            case None:
                message.estimate.frames = self.frames or 0
            case str(grid_id):
                message.grid_id = grid_id
            case types.GridRecord() | types.Estimate():
                message.grid_id = self.grid.grid_id
            case types.Guides():
                message.guides.CopyFrom(to_guides(self.grid))
            case _:
                raise InvalidOption(
                    f"A stream cannot take a {type(self.grid).__name__} for its grid.",
                    allowed="an id, a record, an estimate or guides; client.grids.put makes a record of a lattice",
                )
        return message


@dataclass(frozen=True, slots=True)
class _Sent:
    """A frame that is not answered yet.

    Attributes:
        body: its message, serialized.
        places: where it lies, if it lies in shared memory.
        shape: of its array.
    """

    index: int
    timestamp_us: int
    body: bytes
    places: memory_pb2.SharedPicture | None
    shape: tuple[int, ...] | None


class StreamCore:
    """Numbers frames, keeps them until they are answered, and checks that each is answered once and in order."""

    def __init__(self, layout: FrameLayout, options: StreamOptions) -> None:
        self._layout = layout
        self._options = options
        self._opening = options.opening(layout)
        self._window = options.in_flight
        self._deadline_ms = round(1000 * (options.frame_deadline_s or 0))
        self._reconnects = options.reconnects
        self._unanswered: deque[_Sent] = deque()
        self._next_index = 0
        self._failures = 0
        self._memory: FrameMemory | None = None
        self.opened = False
        self.resumed = False
        self.grid: types.GridRecord | None = None

    @property
    def stream_id(self) -> str:
        return self._opening.stream_id

    @property
    def has_room(self) -> bool:
        """Whether another frame may be sent before an answer."""
        return len(self._unanswered) < self._window

    @property
    def is_waiting(self) -> bool:
        """Whether an answer is due."""
        return bool(self._unanswered)

    def new_memory(self, path: str, timeout_s: float) -> FrameMemory | None:
        """Memory for one connection, shared with the server at ``path``; None for files. Raises as FrameMemory."""
        if self._layout.pixel_format in ENCODED:
            return None
        size_bytes = frame_size_bytes(self._layout.pixel_format, self._layout.width, self._layout.height)
        return FrameMemory(path, size_bytes, self._options.in_flight, timeout_s)

    def first(self, memory: FrameMemory | None = None) -> list[bytes]:
        """What a connection begins with: the opening, and the frames that no connection before it has answered.

        Args:
            memory: that frames go through on this connection. The one before is left as it is: the server may still
                be drawing in it.
        """
        before, self._memory = self._memory, memory
        for _ in range(len(self._unanswered)):
            sent = self._unanswered.popleft()
            if memory is not None and sent.places is not None and before is not None:
                sent = self._through(memory, sent.index, sent.timestamp_us, before.source(sent.places), sent.shape)
            self._unanswered.append(sent)
        return [Request(open=self._opening).SerializeToString(), *(sent.body for sent in self._unanswered)]

    def accept(self, image: types.Image, timestamp_us: int) -> bytes:
        """The message of the next frame, serialized. Raises InvalidFrame."""
        packed = self._layout.pack(image)
        if self._memory is not None:
            sent = self._through(self._memory, self._next_index, timestamp_us, packed.data, packed.shape)
        else:
            rest = correction_pb2.StreamFrame(
                index=self._next_index, timestamp_us=timestamp_us, deadline_ms=self._deadline_ms
            )
            body = attach(FRAME_FIELD, rest.SerializeToString(), FRAME_DATA_FIELD, packed.data)
            sent = _Sent(self._next_index, timestamp_us, body, None, packed.shape)
        self._next_index += 1
        self._unanswered.append(sent)
        return sent.body

    def _through(
        self, memory: FrameMemory, index: int, timestamp_us: int, data: Any, shape: tuple[int, ...] | None
    ) -> _Sent:
        places = memory.put(data)
        frame = correction_pb2.StreamFrame(
            index=index, timestamp_us=timestamp_us, shared=places, deadline_ms=self._deadline_ms
        )
        return _Sent(index, timestamp_us, Request(frame=frame).SerializeToString(), places, shape)

    def forget(self) -> None:
        """Nobody waits any more for the frames that are not answered; the connection has to be given up with them."""
        for sent in self._unanswered:
            if sent.places is not None and self._memory is not None:
                self._memory.free(sent.places)
        self._unanswered.clear()

    def receive(self, response: Answer) -> types.StreamResult | None:
        """What a response says to the caller, if anything. Raises ServerFault for one that should not have come."""
        if isinstance(response, FrameAnswer):
            return self._answer(response.result, response.data)
        match response.WhichOneof("message"):
            case "opened":
                self._open(response.opened)
            case "grid":
                self.grid = from_record(response.grid.record)
                self._opening.estimate_again = False  # it was; a resumed stream keeps the grid
            case "result":
                return self._answer(response.result, response.result.data)
            case _:
                raise ServerFault("The server sent a message that is not known here.")
        return None

    def lost(self, error: UnbendError | None) -> float:
        """The connection ended, by itself (None) or with an error: the pause in seconds before the next one.

        Raises:
            UnbendError: the error, if another connection would not help or enough were tried without an answer.
        """
        if error is None:
            if not self._unanswered:
                return 0.0
            error = ServerFault("The server ended the stream before it had answered every frame.")
        if not isinstance(error, Unavailable | StreamIdle | TooManyRegions | TooManyStreams):
            raise error
        self._failures += 1
        if self._failures > (self._reconnects if self.opened else min(self._reconnects, _ATTEMPTS_TO_OPEN)):
            raise error
        return max(backoff_s(self._failures), error.retry_after_s or 0.0)

    def _open(self, message: correction_pb2.StreamOpened) -> None:
        self.opened = True
        self.resumed = message.resumed
        self._opening.stream_id = message.stream_id
        self._window = max(1, min(self._window, message.max_in_flight or self._window))

    def _answer(self, message: correction_pb2.StreamResult, data: memoryview | bytes) -> types.StreamResult:
        if not self._unanswered or message.index != self._unanswered[0].index:
            raise ServerFault(f"The server answered frame {message.index}, which is not the next one.")
        sent = self._unanswered.popleft()
        self._failures = 0
        if message.status not in STATUSES:
            raise ServerFault(f"The server answered with the frame status {message.status}, which is not known here.")
        status = STATUSES[message.status]
        image, error = None, None
        pictured = status in (types.FrameStatus.CORRECTED, types.FrameStatus.PASSED_THROUGH)
        if sent.places is not None and self._memory is not None:
            if pictured and message.HasField("shared"):
                image = self._layout.unpack(self._memory.take(sent.places), sent.shape)
            else:
                self._memory.free(sent.places)
        if status is types.FrameStatus.FAILED:
            error = of_frame(message.error.code, message.error.message)
        elif pictured and image is None:
            image = self._layout.unpack(data, sent.shape)
        return types.StreamResult(
            sent.index,
            sent.timestamp_us,
            status,
            image,
            error,
            self._layout.pixel_format,
            self._layout.width,
            self._layout.height,
        )


def split(item: types.Image | tuple[types.Image, int]) -> tuple[types.Image, int]:
    """A frame and its timestamp in microseconds: that of a PyAV frame, else 0 if it came without."""
    return item if isinstance(item, tuple) else (item, timestamp_us_of(item))


def read_response(body: bytes) -> Answer:
    """A message of the server; the picture of a result is shown where it lies in ``body``."""
    if (parts := detach(body, RESULT_FIELD, RESULT_DATA_FIELD)) is not None:
        return FrameAnswer(correction_pb2.StreamResult.FromString(parts[0]), parts[1])
    return Response.FromString(body)
