"""What goes into the client and comes out of it.

Frames of reference: every coordinate is centred, x = 2 (i + 0.5) / width - 1 to the right and y = 2 (j + 0.5) / height
- 1 down, so that a picture is [-1, 1]^2. "Source" is the distorted picture, "target" the corrected one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from unbend import _foreign as foreign
from unbend import _notebooks as notebooks
from unbend._errors import InvalidFrame, InvalidGrid, UnbendError


class _PillowImage(Protocol):
    """What is used of a ``PIL.Image.Image``."""

    @property
    def mode(self) -> str: ...

    @property
    def size(self) -> tuple[int, int]: ...

    def convert(self, mode: str) -> Any: ...

    def tobytes(self) -> bytes: ...


class _PyavFrame(Protocol):
    """What is used of an ``av.VideoFrame``."""

    @property
    def width(self) -> int: ...

    @property
    def height(self) -> int: ...

    @property
    def format(self) -> Any: ...

    @property
    def planes(self) -> Any: ...

    def reformat(self, *, format: Any) -> Any: ...

    def to_ndarray(self) -> Any: ...


#: A picture: (height, width[, channels]) uint8, the bytes of an image file, a Pillow image, or a PyAV video frame.
Image = npt.NDArray[np.uint8] | bytes | _PillowImage | _PyavFrame


class Outcome(StrEnum):
    """Whether a picture was changed."""

    CORRECTED = "corrected"
    LEFT_ALONE = "left_alone"


class FrameStatus(StrEnum):
    """What became of a frame of a stream."""

    CORRECTED = "corrected"
    PASSED_THROUGH = "passed_through"
    DROPPED = "dropped"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class Border:
    """What is painted where the source has nothing; 0..255 each, alpha where the format has it.

    >>> white = unbend.Border(255, 255, 255)
    >>> client.correct(np.zeros((48, 64, 3), np.uint8), fit="full", border=white).image.max()
    np.uint8(255)
    """

    red: int = 0
    green: int = 0
    blue: int = 0
    alpha: int = 255


@dataclass(frozen=True, slots=True)
class Guide:
    """One polynomial guide.

    >>> bulging = unbend.Guide(anchor=-0.5, coefficients=(-0.55, 0.0, 0.1))  # y = -0.55 + 0.1 x^2
    >>> len(bulging.coefficients)
    3

    Attributes:
        anchor: where it lies once straight, centred target coordinate in (-1, 1).
        coefficients: c0, c1, ... in centred source coordinates; of a row guide y = c0 + c1 x + c2 x^2 + ..., of a
            column guide x = c0 + c1 y + c2 y^2 + .... Undistorted: (anchor, 0, 0, ...).
    """

    anchor: float
    coefficients: Sequence[float]


@dataclass(frozen=True, slots=True)
class Guides:
    """The curves that ought to be straight: at least two near-horizontal ones and two near-vertical ones.

    >>> rows = [unbend.Guide(-0.5, (-0.55, 0.0, 0.1)), unbend.Guide(0.5, (0.55, 0.0, -0.1))]
    >>> columns = [unbend.Guide(-0.5, (-0.5, 0.0)), unbend.Guide(0.5, (0.5, 0.0))]
    >>> by_hand = client.grids.put(unbend.Guides(rows, columns))
    >>> by_hand.outcome
    <Outcome.CORRECTED: 'corrected'>
    """

    rows: Sequence[Guide]
    columns: Sequence[Guide]


@dataclass(frozen=True, eq=False, slots=True)
class Grid:
    """A lattice of source points for a regular lattice over the target, the backward map of the correction.

    >>> s, t = np.meshgrid(np.linspace(-1, 1, 33), np.linspace(-1, 1, 33))
    >>> shrink = 1 - 0.1 * (s * s + t * t)  # a barrel, undone
    >>> grid = unbend.Grid(np.stack([s * shrink, t * shrink], axis=-1))
    >>> grid.rows, grid.columns
    (33, 33)
    >>> client.correct(np.zeros((48, 64, 3), np.uint8), grid=grid).image.shape
    (48, 64, 3)

    Attributes:
        source: (rows, columns, 2) float32, 2..1025 rows and columns, centred: ``source[r, c] = (x, y)`` is the source
            point of the target point (2 c / (columns - 1) - 1, 2 r / (rows - 1) - 1).

    Raises:
        InvalidGrid: another shape.
    """

    source: npt.NDArray[np.float32]

    def __post_init__(self) -> None:
        source = np.ascontiguousarray(self.source, dtype=np.float32)
        if source.ndim != 3 or source.shape[2] != 2:
            raise InvalidGrid(f"A grid of shape {source.shape}.", allowed="(rows, columns, 2)")
        object.__setattr__(self, "source", source)

    @property
    def rows(self) -> int:
        return int(self.source.shape[0])

    @property
    def columns(self) -> int:
        return int(self.source.shape[1])


@dataclass(frozen=True, eq=False, slots=True)
class GridRecord:
    """A grid and where it came from.

    >>> record = client.estimate(np.zeros((48, 64, 3), np.uint8)).record
    >>> client.grids.get(record.grid_id).grid_id == record.grid_id
    True

    Attributes:
        grid_id: content-derived; stands for the grid in later calls.
        confidence: 0..1; ``confidence_kind`` says what it means (``mirror_agreement``, ``calibrated_probability`` or
            ``given``).
        outcome: whether the grid changes anything.
        reason: why it changes nothing, or less than was estimated: ``low_confidence``, ``nothing_to_correct`` or
            ``folded``; else empty.
        strength: share of the estimated correction that is in the grid.
        model: name of the network that estimated, empty for grids that came from elsewhere.
        grid: the lattice; None where only the id was asked for.
        guides: the guides it was spun from; None where there are none or only the id was asked for.
    """

    grid_id: str
    confidence: float
    confidence_kind: str
    outcome: Outcome
    reason: str
    strength: float
    model: str
    grid: Grid | None = field(default=None, repr=False)
    guides: Guides | None = field(default=None, repr=False)


@dataclass(frozen=True, eq=False, slots=True)
class Estimate:
    """How one picture is bent; given as ``grid``, it corrects others of the same camera.

    >>> estimate = client.estimate(np.zeros((48, 64, 3), np.uint8))
    >>> others = [client.correct(np.zeros((48, 64, 3), np.uint8), grid=estimate) for _ in range(2)]
    >>> {other.grid_id for other in others} == {estimate.grid_id}
    True

    Attributes:
        record: what is stored on the server under ``grid_id``, lattice and guides included.
    """

    record: GridRecord

    @property
    def grid_id(self) -> str:
        return self.record.grid_id

    @property
    def confidence(self) -> float:
        return self.record.confidence

    @property
    def outcome(self) -> Outcome:
        return self.record.outcome

    @property
    def reason(self) -> str:
        return self.record.reason

    @property
    def grid(self) -> Grid:
        assert self.record.grid is not None
        return self.record.grid

    @property
    def guides(self) -> Guides | None:
        return self.record.guides


@dataclass(frozen=True, eq=False, slots=True)
class Correction:
    """One corrected picture; a notebook shows it beside the one that was sent.

    >>> correction = client.correct(np.zeros((48, 64, 3), np.uint8))
    >>> correction.to_pil().size
    (64, 48)

    Attributes:
        image: an array of the shape that was sent (of a Pillow image or a PyAV frame: of the array that it became), or
            the bytes of a file if a file was sent.
        record: the grid behind it, before fit and strength; without lattice and guides.
        pixel_format: what ``image`` holds: rgb24 for one, or jpeg.
        before: what was sent, read-only, like ``image``; None if it is not known.
    """

    image: Any = field(repr=False)
    record: GridRecord
    pixel_format: str = ""
    before: Any = field(default=None, repr=False)

    @property
    def grid_id(self) -> str:
        return self.record.grid_id

    @property
    def confidence(self) -> float:
        return self.record.confidence

    @property
    def outcome(self) -> Outcome:
        return self.record.outcome

    @property
    def reason(self) -> str:
        return self.record.reason

    def to_pil(self) -> Any:
        """The picture as a ``PIL.Image.Image``. Raises MissingPackage without Pillow."""
        return foreign.to_pil(self.image, self.pixel_format, *self._size())

    def to_av(self) -> Any:
        """The picture as an ``av.VideoFrame`` of the same pixel format. Raises MissingPackage without PyAV."""
        return foreign.to_av(self.image, self.pixel_format, *self._size())

    def _size(self) -> tuple[int, int]:
        """Width and height in pixels; (0, 0) of a file."""
        if isinstance(self.image, bytes):
            return 0, 0
        height, width = self.image.shape[:2]
        return width, height * 2 // 3 if self.pixel_format in ("i420", "nv12") else height

    def _repr_html_(self) -> str:
        outcome = self.outcome.value.replace("_", " ")
        reason = f" ({self.reason.replace('_', ' ')})" if self.reason else ""
        caption = f"{outcome}{reason}, confidence {self.confidence:.2f}, grid {self.grid_id}"
        return notebooks.draw_comparison(self.before, self.image, self.pixel_format, caption)


@dataclass(frozen=True, eq=False, slots=True)
class StreamResult:
    """The answer to one frame.

    >>> with client.stream(64, 48) as stream:
    ...     (result,) = stream.correct([(np.zeros((48, 64, 3), np.uint8), 40_000)])
    >>> result.status, result.timestamp_us, result.to_pil().size
    (<FrameStatus.CORRECTED: 'corrected'>, 40000, (64, 48))

    Attributes:
        index: number of the frame in its stream, from 0.
        timestamp_us: as it was sent.
        status: what became of it.
        image: like the frame that was sent: an array of its shape (read-only: copy it to draw on it) or bytes; None
            for a frame that was dropped or failed.
        error: why it failed; None otherwise.
        pixel_format: of the stream.
        width, height: of the stream in pixels; 0 for files.
    """

    index: int
    timestamp_us: int
    status: FrameStatus
    image: Any = field(default=None, repr=False)
    error: UnbendError | None = None
    pixel_format: str = field(default="", repr=False)
    width: int = field(default=0, repr=False)
    height: int = field(default=0, repr=False)

    def to_pil(self) -> Any:
        """The frame as a ``PIL.Image.Image``. Raises MissingPackage without Pillow, and InvalidFrame without image."""
        return foreign.to_pil(self._picture(), self.pixel_format, self.width, self.height)

    def to_av(self) -> Any:
        """The frame as an ``av.VideoFrame`` of the same pixel format, without a timestamp.

        Raises:
            MissingPackage: PyAV is not installed.
            InvalidFrame: the frame has no image, or chroma of an odd size.
        """
        return foreign.to_av(self._picture(), self.pixel_format, self.width, self.height)

    def _picture(self) -> Any:
        if self.image is None:
            raise InvalidFrame(f"Frame {self.index} was {self.status.value}: there is no image.")
        return self.image
