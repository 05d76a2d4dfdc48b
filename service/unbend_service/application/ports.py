"""What the use cases need from the outside. Adapters implement these; ``wiring`` plugs them in."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from unbend_service.application.exhibit import Exhibit, Subject
from unbend_service.domain.access import Grant
from unbend_service.domain.decision import TRUSTING, Caution
from unbend_service.domain.exchange import DenseMap, ExportedFile, ExportFormat, ImportFormat
from unbend_service.domain.frames import Border, Frame
from unbend_service.domain.grid import Grid
from unbend_service.domain.guides import Guides
from unbend_service.domain.maps import BackwardMap
from unbend_service.domain.records import GridRecord

Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class ModelInfo:
    """Which network answered.

    Attributes:
        name: short name, as the setting ``model`` takes it.
        sha256: of the weight file, lower-case hex.
        caution: that its card advises for a picture's lens.
    """

    name: str
    sha256: str
    caution: Caution = TRUSTING


@dataclass(frozen=True, slots=True)
class Estimate:
    """What an estimator says of one picture.

    Attributes:
        guides: estimated guides, centred coordinates.
        confidence: 0..1; what it means is said by ``confidence_kind``.
        confidence_kind: ``mirror_agreement`` or ``calibrated_probability``.
        expected_error: expected mean error of the nonlinear part in half picture widths, None if the model has no say.
        model: which network answered.
    """

    guides: Guides
    confidence: float
    confidence_kind: str
    model: ModelInfo
    expected_error: float | None = None


class Estimator(Protocol):
    """Looks at one picture. Thread-safe; blocking (the use case runs it off the event loop)."""

    @property
    def model(self) -> ModelInfo: ...

    def estimate(self, grey: Bytes) -> Estimate:
        """(height, width) uint8 grey, any size, upright -> Estimate."""
        ...


@dataclass(frozen=True, slots=True)
class RendererInfo:
    """Which renderer the workers run.

    Attributes:
        name: ``egl`` or ``cpu``.
        device: the GL renderer string, or the name of the CPU path.
        hardware: whether a GPU does the work.
    """

    name: str
    device: str
    hardware: bool


class Renderer(Protocol):
    """Draws one frame through a grid, inside a worker process. Not thread-safe; owns native contexts."""

    @property
    def info(self) -> RendererInfo: ...

    def render(self, source: Frame, grid: Grid, border: Border, target: Bytes) -> None:
        """Writes the corrected frame into ``target``.

        A target pixel whose source point lies inside [-1, 1]^2 is sampled bilinearly, clamped at the edge of the
        source; any other is painted with ``border``. Chroma planes are sampled at their own resolution. The target
        has the format and size of ``source``.

        Args:
            source: the distorted frame.
            grid: target -> source, already fitted.
            target: (frame_size_bytes,) uint8, writable.
        """
        ...

    def rest(self) -> None:
        """Nothing was drawn for a while: gives back what is kept for a next frame of the same size alone."""
        ...

    def close(self) -> None: ...


@dataclass(slots=True)
class WorkerState:
    """One render worker, for /readyz and metrics."""

    name: str
    state: str  # starting | ready | busy | dead
    pid: int | None = None
    restarts: int = 0


@dataclass(slots=True)
class PoolState:
    """What the pool looks like now.

    Attributes:
        ready: whether a frame sent now would be rendered.
        reason: why not, in one sentence.
        queued: frames that wait for a worker.
    """

    ready: bool
    reason: str
    renderer: RendererInfo | None
    queued: int
    workers: list[WorkerState] = field(default_factory=list)


class SharedMemory(Protocol):
    """Memory of a client on the same host, seen by this process and by the workers."""

    @property
    def size_bytes(self) -> int: ...

    @property
    def memory(self) -> Bytes:
        """(size_bytes,) uint8 view, writable; the client may write too, at any moment."""
        ...


@dataclass(frozen=True, slots=True)
class SharedPicture:
    """A raw picture in the memory of a client.

    Attributes:
        memory: whose.
        source_offset: bytes from its start to the picture.
        target_offset: bytes from its start to where the answer is put.
        source, target: (size,) uint8 views of the same, which keep the memory mapped.
    """

    memory: SharedMemory
    source_offset: int
    target_offset: int
    source: Bytes
    target: Bytes


class RenderPool(Protocol):
    """Renders frames in worker processes."""

    async def start(self) -> None:
        """Starts the workers and waits until the first is ready.

        Raises:
            RendererUnavailable: none could be started, or a GPU is required and missing.
        """
        ...

    async def render(
        self,
        frame: Frame,
        grid: Grid,
        border: Border,
        *,
        affinity: str | None = None,
        deadline_s: float | None = None,
        shared: SharedPicture | None = None,
    ) -> Bytes:
        """The corrected frame, (frame_size_bytes,) uint8, owned by the caller.

        A worker that dies while it has the frame is replaced and the frame is rendered by another.

        Args:
            shared: where the frame lies, if it lies in the memory of a client: the workers read it there and put the
                answer into its ``target``, which is returned. However the call ends, nobody writes there afterwards,
                except when it is cancelled.
            affinity: frames with the same key prefer the same worker, whose maps and textures are warm, and share one
                turn in the queue.
            deadline_s: seconds from now after which the answer is worthless.

        Raises:
            QueueFull, DeadlineExceeded, PoisonFrame, RendererUnavailable, Draining.
            RegionNotFound: the client has taken its memory back.
        """
        ...

    def adopt(self, fd: int, size_bytes: int) -> SharedMemory:
        """Maps memory of a client, whose descriptor belongs to the pool from now on, whatever happens.

        Raises:
            InvalidRegion: it is not memory that stays, or smaller than ``size_bytes``.
        """
        ...

    def disown(self, memory: SharedMemory) -> None:
        """Unmaps memory of a client everywhere, once no frame that is under way needs it."""
        ...

    def state(self) -> PoolState: ...

    async def close(self, grace_s: float) -> None:
        """Finishes what was accepted, at most ``grace_s`` seconds, then ends the workers and frees shared memory."""
        ...


class GridStore(Protocol):
    """Keeps grids by their content-derived id, and which grid a stream was given."""

    async def put(self, record: GridRecord) -> None: ...

    async def get(self, grid_id: str) -> GridRecord:
        """Raises GridNotFound."""
        ...

    async def delete(self, grid_id: str) -> None:
        """Raises GridNotFound."""
        ...

    async def bind_stream(self, stream_id: str, grid_id: str, *, replace: bool = True) -> str:
        """Remembers the grid of a stream, so that a resumed stream gets the same one without a new estimate.

        Returns the grid id that is bound now: without ``replace`` the one that was, while its grid is kept.
        """
        ...

    async def stream_grid(self, stream_id: str) -> str | None:
        """The grid id that was bound, None if there is none (any more)."""
        ...

    async def claim_stream(self, stream_id: str, token: str, lease_s: float) -> bool:
        """Whether the grid of a stream is ``token``'s to estimate; nobody else's for the next ``lease_s`` seconds.

        Asked again with the same token, the lease begins anew. A holder that dies loses it by time.
        """
        ...

    async def release_stream(self, stream_id: str, token: str) -> None:
        """Gives a claim up; without effect if it is not ``token``'s."""
        ...

    async def camera(self, name: str) -> bytes | None:
        """What is remembered of a camera, None if nothing (any more)."""
        ...

    async def swap_camera(self, name: str, known: bytes | None, value: bytes | None) -> bool:
        """Replaces what is remembered of a camera, if that is still ``known``; None stands for nothing on both sides.

        Returns:
            Whether it was: someone else may have been faster.
        """
        ...

    async def close(self) -> None: ...


@dataclass(frozen=True, slots=True)
class ImageHeader:
    """What the first bytes of an encoded image say, before anything is decoded.

    Attributes:
        image_format: ``jpeg``, ``png``, ``webp``, ``tiff`` or ``bmp``.
        width, height: pixels as stored, before EXIF orientation.
        has_alpha: whether the decoded image keeps an alpha channel.
    """

    image_format: str
    width: int
    height: int
    has_alpha: bool


@dataclass(frozen=True, slots=True)
class PictureOrigin:
    """What the header of an encoded picture says of its making.

    Attributes:
        aspect: width over height, upright.
        camera: a name for the camera, lens and focal length; None if the file names none.
    """

    aspect: float
    camera: str | None


@dataclass(frozen=True, slots=True)
class DecodedImage:
    """A decoded picture, upright (EXIF orientation applied).

    Attributes:
        frame: rgb24, rgba or gray8; yuvj420p where planes were asked for.
        image_format: of the file it came from.
        exif: EXIF block without its orientation, to be written back; None if there was none.
        icc_profile: bytes to be written back; None if there was none or it no longer applies.
        upright: whether the file was stored upright, so that its own bytes show the same picture.
        chroma_subsampling: of a jpeg, ``4:4:4``, ``4:2:2`` or ``4:2:0``, kept when jpeg is written; None if unknown.
    """

    frame: Frame
    image_format: str
    exif: bytes | None = None
    icc_profile: bytes | None = None
    upright: bool = True
    chroma_subsampling: str | None = None


class ImageCodec(Protocol):
    """Encoded images to frames and back. Thread-safe; blocking."""

    def start(self) -> None:
        """Makes ready what decodes; returns at once."""
        ...

    def close(self) -> None:
        """Frees what it holds; what is decoded then may fail."""
        ...

    def probe(self, body: bytes) -> ImageHeader:
        """Reads the header only.

        Raises:
            EmptyBody, UnsupportedMediaType, InvalidImage, TooManyPixels.
        """
        ...

    def origin(self, body: bytes) -> PictureOrigin:
        """Reads the header only; raises as :meth:`probe`."""
        ...

    def decode(self, body: bytes, planes: bool = False) -> DecodedImage:
        """Raises as :meth:`probe`, and InvalidImage for a broken body.

        Args:
            planes: whether a jpeg may be left as planes, because it is to be encoded as a jpeg again; where the codec
                cannot, it comes packed all the same.
        """
        ...

    def decode_grey(self, body: bytes, longest_px: int) -> Bytes:
        """(height, width) uint8, upright, reduced so that the longer side is near ``longest_px`` (never enlarged)."""
        ...

    def encode(self, image: DecodedImage, image_format: str, quality: int) -> bytes:
        """jpeg, png or webp with the EXIF block and ICC profile of ``image``; ``quality`` is 1..100.

        Raises:
            InvalidOption: a format that is not written.
        """
        ...


class GridFiles(Protocol):
    """Grids as the files of other programs. Thread-safe; blocking."""

    def write_record(self, record: GridRecord) -> ExportedFile:
        """The JSON of the API."""
        ...

    def read_record(self, body: bytes) -> GridRecord:
        """Inverse of :meth:`write_record`; a grid or guides alone are accepted too.

        Raises:
            InvalidGrid, InvalidGuides.
        """
        ...

    def write_map(self, kind: ExportFormat, dense: DenseMap) -> ExportedFile:
        """Any format but json.

        Raises:
            InvalidOption: a size that the format cannot hold.
            Unavailable: the library that writes it is not installed.
        """
        ...

    def read_map(self, kind: ImportFormat, body: bytes) -> BackwardMap:
        """Any format but json; target -> source, centred.

        Raises:
            InvalidGrid: the file is broken or holds something else.
            Unavailable: the library that reads it is not installed.
        """
        ...


class Illustrator(Protocol):
    """Draws figures of what was estimated of a picture. Thread-safe; blocking.

    Both raise InvalidFrame for a planar frame, and InvalidOption for guides of a grid that has none.
    """

    def raster(self, subject: Subject, exhibit: Exhibit) -> Frame:
        """The figure as rgb24: overlays have the size of the picture, others that of their panels."""
        ...

    def vector(self, subject: Subject, exhibit: Exhibit) -> bytes:
        """The same figure as SVG, UTF-8."""
        ...


class TokenSource(Protocol):
    """The tokens that are accepted. Blocking."""

    def read(self) -> Sequence[Grant] | None:
        """All of them if they changed since the last call, else None.

        Raises:
            InvalidOption: they cannot be read; raised once for each change.
        """
        ...


class Meter(Protocol):
    """Counts what happens. Never blocks, never raises."""

    def request(self, transport: str, method: str, code: str, seconds: float) -> None: ...

    def stage(self, stage: str, seconds: float) -> None:
        """``stage`` is queue, decode, estimate, grid, render or encode."""
        ...

    def frame(self, result: str) -> None:
        """``result`` is corrected, left_alone, passed_through (its stream had no grid yet), dropped or failed."""
        ...

    def estimate(self, outcome: str) -> None:
        """One decision, ``corrected`` or ``left_alone``: once a picture or a stream, however many frames it took."""
        ...

    def stream_opened(self) -> None: ...

    def stream_closed(self) -> None: ...

    def rejected(self, reason: str) -> None: ...

    def worker_restarted(self, reason: str) -> None: ...

    def grid_cache(self, hit: bool) -> None: ...

    def grid_store(self, operation: str, result: str) -> None:
        """One call of a shared grid store; ``result`` is shared, local (the replica helped itself) or unreadable."""
        ...

    def grid_store_up(self, up: bool) -> None:
        """Whether the shared grid store answers, when that changes."""
        ...

    def pool(self, state: PoolState) -> None: ...

    def model(self, model: ModelInfo) -> None: ...

    def render(self) -> tuple[bytes, str]:
        """Everything counted so far as text for a scraper, and its content type."""
        ...


class RequestTrace(Protocol):
    """One request in its trace.

    Attributes:
        trace_id: 32 hexadecimal digits; empty where there is none.
    """

    trace_id: str

    def answered(self, name: str, code: str, failed: bool) -> None:
        """Says what the request was, and how it ended; ``failed``: through a fault of the service."""
        ...


class Tracer(Protocol):
    """Makes spans of requests. Never blocks, never raises."""

    def request(
        self, transport: str, name: str, request_id: str, traceparent: str | None
    ) -> AbstractContextManager[RequestTrace]:
        """Around a request; ``traceparent`` is what the caller says of his trace."""
        ...

    async def close(self) -> None:
        """Sends what waits, for a few seconds at most."""
        ...
