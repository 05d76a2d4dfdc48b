"""Renderers, and the pool of workers that holds them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

from unbend_service.domain.frames import Border, Bytes, Frame
from unbend_service.domain.grid import Grid


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
