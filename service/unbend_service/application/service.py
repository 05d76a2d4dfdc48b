"""The application as the transports see it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from unbend_service.application.access import Access
from unbend_service.application.admission import Admission
from unbend_service.application.blocking import BlockingWork
from unbend_service.application.budget import MemoryBudget
from unbend_service.application.correction import Correction
from unbend_service.application.estimation import Estimation
from unbend_service.application.exchange import Exchange
from unbend_service.application.grids import GridLibrary
from unbend_service.application.illustration import Illustration
from unbend_service.application.ports import (
    Estimator,
    GridStore,
    ImageCodec,
    Meter,
    ModelInfo,
    PoolState,
    RenderPool,
    Tracer,
)
from unbend_service.application.regions import Regions
from unbend_service.application.streams import Streams
from unbend_service.application.tracing import NoTracer


@dataclass(frozen=True, slots=True)
class Readiness:
    """Whether calls sent now would be answered.

    Attributes:
        reasons: why not, one sentence each; empty when ready.
        pool: the render workers.
        model: the network that estimates.
        streams: streams that are open.
        active: calls under way.
        role: what this node does: all, estimate or render.
    """

    ready: bool
    reasons: list[str]
    pool: PoolState
    model: ModelInfo
    streams: int
    active: int
    role: str = "all"


@dataclass(slots=True)
class Service:
    """Use cases and what they share.

    Attributes:
        bodies: bounds the request bodies in memory.
        closing: called last, for what else has to be freed.
    """

    estimation: Estimation
    correction: Correction
    illustration: Illustration
    grids: GridLibrary
    exchange: Exchange
    streams: Streams
    regions: Regions
    pool: RenderPool
    store: GridStore
    codec: ImageCodec
    meter: Meter
    blocking: BlockingWork
    estimator: Estimator
    bodies: MemoryBudget
    access: Access
    admission: Admission = field(default_factory=Admission)
    role: str = "all"
    tracer: Tracer = field(default_factory=NoTracer)
    closing: tuple[Callable[[], None], ...] = ()

    @property
    def model(self) -> ModelInfo:
        """The network that estimates; of another node what it said last."""
        return self.estimator.model

    async def start(self) -> None:
        """Starts the render workers. Raises RendererUnavailable."""
        self.codec.start()
        await self.pool.start()
        self.meter.model(self.model)
        self.meter.pool(self.pool.state())

    def readiness(self) -> Readiness:
        """Cheap; asked by probes."""
        state = self.pool.state()
        reasons = [] if state.ready else [state.reason]
        if self.admission.leaving:
            reasons.append("The service is shutting down.")
        return Readiness(not reasons, reasons, state, self.model, self.streams.active, self.admission.active, self.role)

    async def close(self, grace_s: float) -> None:
        """Refuses new calls, lets those under way finish for ``grace_s`` seconds, then frees everything."""
        end = time.monotonic() + grace_s
        await self.admission.drain(grace_s)
        await self.pool.close(max(0.0, end - time.monotonic()))
        self.blocking.close()
        self.codec.close()
        await self.store.close()
        for free in self.closing:
            free()
        await self.tracer.close()
