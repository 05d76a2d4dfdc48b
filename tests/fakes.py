"""Fakes of the ports: small and honest, with no process, no network and no model behind them."""

from __future__ import annotations

import itertools
from collections import Counter
from dataclasses import dataclass, field

import cv2
import numpy as np

from unbend_service.adapters.renderers.regions import RegionKeeper
from unbend_service.application.ports import (
    Bytes,
    Estimate,
    ModelInfo,
    PoolState,
    RendererInfo,
    SharedMemory,
    SharedPicture,
    WorkerState,
)
from unbend_service.domain.decision import Caution
from unbend_service.domain.errors import Draining, UnbendError
from unbend_service.domain.frames import Border, Frame, split_planes
from unbend_service.domain.grid import Grid
from unbend_service.domain.guides import GuideFamily, Guides
from unbend_service.domain.maps import pixel_centres
from unbend_service.domain.records import GridRecord

FAKE_MODEL = ModelInfo(name="fake", sha256="0" * 64, caution=Caution(0.3, 0.6, 0.5 * 2 / 256))


def barrel_guides(bend: float = 0.06) -> Guides:
    """Guides of a barrel-like picture: lines far from the centre bow outwards by ``bend`` at their middle."""
    anchors = np.array([-0.9, -0.3, 0.3, 0.9])
    coefficients = np.zeros((4, 6))
    coefficients[:, 0] = anchors * (1 + bend / 2)
    coefficients[:, 2] = -anchors * bend
    return Guides(GuideFamily(anchors, coefficients), GuideFamily(anchors, coefficients))


RECORD = GridRecord(Grid.from_map(barrel_guides(), 33, 33))


@dataclass
class FakeEstimator:
    """Gives the guides it was given, and remembers the shapes it was shown."""

    guides: Guides = field(default_factory=barrel_guides)
    confidence: float = 0.9
    seen: list[tuple[int, ...]] = field(default_factory=list)
    failure: Exception | None = None

    @property
    def model(self) -> ModelInfo:
        return FAKE_MODEL

    def estimate(self, grey: Bytes) -> Estimate:
        self.seen.append(grey.shape)
        if self.failure is not None:
            raise self.failure
        return Estimate(self.guides, self.confidence, "mirror_agreement", FAKE_MODEL)


def draw_through(frame: Frame, grid: Grid, border: Border) -> Bytes:
    """The corrected frame as the port Renderer describes it, (frame_size_bytes,) uint8."""
    target = np.empty_like(frame.data)
    sources = frame.plane_arrays()
    targets = split_planes(target, frame.pixel_format, frame.width, frame.height)
    for source, out, colour in zip(sources, targets, border.samples(frame.pixel_format), strict=True):
        height, width = source.shape[:2]
        lattice = np.stack(np.meshgrid(pixel_centres(width), pixel_centres(height)), axis=-1)
        points = grid(lattice)
        x = ((points[..., 0] + 1) / 2 * width - 0.5).astype(np.float32)
        y = ((points[..., 1] + 1) / 2 * height - 0.5).astype(np.float32)
        drawn = cv2.remap(source, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).reshape(out.shape)
        outside = (np.abs(points) > 1).any(axis=-1)
        drawn[outside] = colour if out.ndim == 3 else colour[0]
        out[...] = drawn
    return target


@dataclass
class FakeRenderPool:
    """Renders in the calling process; ``failure`` is raised instead while it is set."""

    failure: UnbendError | None = None
    ready: bool = True
    rendered: int = 0
    closed: bool = False
    regions: RegionKeeper = field(default_factory=lambda: RegionKeeper(itertools.count().__next__, lambda _: None))

    async def start(self) -> None:
        self.ready = True

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
        if self.closed:
            raise Draining("The service is shutting down.")
        if self.failure is not None:
            raise self.failure
        self.rendered += 1
        drawn = draw_through(frame, grid, border)
        if shared is None:
            return drawn
        np.copyto(shared.target, drawn)
        return shared.target

    def adopt(self, fd: int, size_bytes: int) -> SharedMemory:
        return self.regions.adopt(fd, size_bytes)

    def disown(self, memory: SharedMemory) -> None:
        self.regions.disown(memory)

    def state(self) -> PoolState:
        worker = WorkerState("fake-0", "ready" if self.ready else "starting")
        reason = "" if self.ready else "No worker is ready yet."
        return PoolState(self.ready, reason, RendererInfo("cpu", "fake", hardware=False), 0, [worker])

    async def close(self, grace_s: float) -> None:
        self.closed = True
        self.ready = False


class RecordingMeter:
    """Remembers what it was told."""

    def __init__(self) -> None:
        self.requests: list[tuple[str, str, str]] = []
        self.stages: Counter[str] = Counter()
        self.frames: Counter[str] = Counter()
        self.estimates: Counter[str] = Counter()
        self.rejections: Counter[str] = Counter()
        self.restarts: Counter[str] = Counter()
        self.cache: Counter[bool] = Counter()
        self.store: Counter[tuple[str, str]] = Counter()
        self.store_up: list[bool] = []
        self.streams_open = 0
        self.pools: list[PoolState] = []
        self.models: list[ModelInfo] = []

    def request(self, transport: str, method: str, code: str, seconds: float) -> None:
        self.requests.append((transport, method, code))

    def stage(self, stage: str, seconds: float) -> None:
        self.stages[stage] += 1

    def frame(self, result: str) -> None:
        self.frames[result] += 1

    def estimate(self, outcome: str) -> None:
        self.estimates[outcome] += 1

    def stream_opened(self) -> None:
        self.streams_open += 1

    def stream_closed(self) -> None:
        self.streams_open -= 1

    def rejected(self, reason: str) -> None:
        self.rejections[reason] += 1

    def worker_restarted(self, reason: str) -> None:
        self.restarts[reason] += 1

    def grid_cache(self, hit: bool) -> None:
        self.cache[hit] += 1

    def grid_store(self, operation: str, result: str) -> None:
        self.store[operation, result] += 1

    def grid_store_up(self, up: bool) -> None:
        self.store_up.append(up)

    def pool(self, state: PoolState) -> None:
        self.pools.append(state)

    def model(self, model: ModelInfo) -> None:
        self.models.append(model)

    def render(self) -> tuple[bytes, str]:
        return repr(vars(self)).encode(), "text/plain"
