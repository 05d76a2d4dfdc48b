"""What goes into a stream and what comes out of it."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from enum import StrEnum

from unbend_service.application.correction import WRITTEN_FORMATS, CorrectOptions
from unbend_service.application.estimation import check_confidence
from unbend_service.domain.errors import InvalidFrame, InvalidOption, TooManyPixels, UnbendError, UnsupportedPixelFormat
from unbend_service.domain.fit import check_strength
from unbend_service.domain.frames import Bytes, PixelFormat
from unbend_service.domain.guides import Guides
from unbend_service.domain.records import GridRecord

MAX_ESTIMATE_FRAMES = 64
_STREAM_ID = re.compile(r"[A-Za-z0-9._:-]{1,128}")


class WhileEstimating(StrEnum):
    """What happens to frames that come before the grid is fixed: they wait for it, or come back as they are."""

    HOLD = "hold"
    PASS_THROUGH = "pass_through"


class Delivery(StrEnum):
    """What happens when frames come faster than they are rendered: reading stops, or the newest replaces a waiting."""

    LOSSLESS = "lossless"
    LATEST = "latest"


class FrameStatus(StrEnum):
    """What became of a frame."""

    CORRECTED = "corrected"
    PASSED_THROUGH = "passed_through"
    DROPPED = "dropped"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class RawFormat:
    """Frames are raw pictures of one size, in pixels."""

    pixel_format: PixelFormat
    width: int
    height: int


@dataclass(frozen=True, slots=True)
class EncodedFormat:
    """Frames are files: ``jpeg``, ``png`` or ``webp``; each may have its own size."""

    image_format: str


@dataclass(frozen=True, slots=True)
class EstimateOver:
    """The grid is estimated over the first frames; None takes the setting ``stream_estimate_frames``."""

    frames: int | None = None


@dataclass(frozen=True, slots=True)
class StoredGrid:
    """The grid is one that is stored."""

    grid_id: str


@dataclass(frozen=True, slots=True)
class DrawnGuides:
    """The grid is spun from guides that the client sends: all of their map."""

    guides: Guides


GridSource = EstimateOver | StoredGrid | DrawnGuides


@dataclass(frozen=True, slots=True)
class StreamConfig:
    """How a stream is to be treated; fixed for its life.

    Attributes:
        frame_format: layout of every frame; results have the same.
        stream_id: 1..128 characters of [A-Za-z0-9._:-]; empty lets the service choose.
        options: correct and min_confidence of the estimate; fit, strength, border and quality of the rendering.
        grid_source: where the grid comes from.
        estimate_again: estimate anew although the stream id has a grid.
    """

    frame_format: RawFormat | EncodedFormat
    stream_id: str = ""
    options: CorrectOptions = field(default_factory=CorrectOptions)
    grid_source: GridSource = EstimateOver()
    while_estimating: WhileEstimating = WhileEstimating.HOLD
    delivery: Delivery = Delivery.LOSSLESS
    estimate_again: bool = False

    def check(self, source_pixels: int) -> None:
        """Refuses what no stream can have.

        Raises:
            InvalidOption, InvalidFrame, UnsupportedPixelFormat, TooManyPixels.
        """
        if self.stream_id and not _STREAM_ID.fullmatch(self.stream_id):
            raise InvalidOption(
                "The stream id has a character that is not allowed, or is too long.",
                allowed="1 to 128 characters of [A-Za-z0-9._:-]",
            )
        match self.frame_format:
            case RawFormat(_, width, height):
                if width < 1 or height < 1:
                    raise InvalidFrame(f"A frame of {width}x{height} pixels has no picture.", allowed="1x1 and more")
                if width * height > source_pixels:
                    raise TooManyPixels(
                        f"A frame of {width}x{height} pixels.",
                        allowed=f"{source_pixels} pixels",
                        setting="source_pixels",
                    )
            case EncodedFormat(image_format):
                if image_format not in WRITTEN_FORMATS:
                    raise UnsupportedPixelFormat(
                        f"Frames cannot be {image_format!r} files.", allowed=", ".join(WRITTEN_FORMATS)
                    )
        if isinstance(self.grid_source, EstimateOver):
            frames = self.grid_source.frames
            if frames is not None and not 1 <= frames <= MAX_ESTIMATE_FRAMES:
                raise InvalidOption(f"An estimate over {frames} frames.", allowed=f"1 to {MAX_ESTIMATE_FRAMES}")
        check_strength(self.options.strength)
        if self.options.min_confidence is not None:
            check_confidence(self.options.min_confidence)


@dataclass(frozen=True, slots=True)
class SharedPlaces:
    """Where a client says that a picture lies, and where it wants the answer; not checked yet.

    Attributes:
        region_id: of registered memory.
        source_offset, target_offset: bytes from its start.
        size_bytes: of the picture, and of its answer.
    """

    region_id: str
    source_offset: int
    target_offset: int
    size_bytes: int


@dataclass(frozen=True, slots=True)
class StreamFrame:
    """One frame.

    Attributes:
        index: strictly increasing within a connection; comes back with the result.
        timestamp_us: presentation time in microseconds, any origin; comes back with the result.
        data: the picture, in the layout of the stream; empty with ``shared``.
        shared: where the picture lies in the memory of the client, if it does.
        deadline_s: seconds after which nobody wants the answer, counted from the reading of the frame; None: no end.
    """

    index: int
    timestamp_us: int
    data: bytes | memoryview
    shared: SharedPlaces | None = None
    deadline_s: float | None = None


@dataclass(frozen=True, slots=True)
class GridFixed:
    """The grid of the stream is known (before fit and strength); comes before the first result that uses it."""

    record: GridRecord


@dataclass(frozen=True, slots=True)
class StreamResult:
    """The answer to one frame.

    Attributes:
        index, timestamp_us: of the frame.
        status: what became of it.
        data: the picture, bytes or a (size,) uint8 array; empty for a frame that was dropped or failed.
        error: why it failed.
        shared: with a picture that was put into the memory of the client instead.
    """

    index: int
    timestamp_us: int
    status: FrameStatus
    data: bytes | memoryview | Bytes = b""
    error: UnbendError | None = None
    shared: SharedPlaces | None = None


StreamEvent = GridFixed | StreamResult
