"""What the use cases need from the outside. Adapters implement these; ``wiring`` plugs them in."""

from __future__ import annotations

from unbend_service.application.ports.estimating import Estimate, Estimator, ModelInfo
from unbend_service.application.ports.grids import GridFiles, GridStore, Illustrator
from unbend_service.application.ports.images import DecodedImage, ImageCodec, ImageHeader, PictureOrigin
from unbend_service.application.ports.observing import Meter, RequestTrace, TokenSource, Tracer
from unbend_service.application.ports.rendering import (
    PoolState,
    Renderer,
    RendererInfo,
    RenderPool,
    SharedMemory,
    SharedPicture,
    WorkerState,
)
from unbend_service.domain.frames import Bytes

__all__ = [
    "Bytes",
    "DecodedImage",
    "Estimate",
    "Estimator",
    "GridFiles",
    "GridStore",
    "Illustrator",
    "ImageCodec",
    "ImageHeader",
    "Meter",
    "ModelInfo",
    "PictureOrigin",
    "PoolState",
    "RenderPool",
    "Renderer",
    "RendererInfo",
    "RequestTrace",
    "SharedMemory",
    "SharedPicture",
    "TokenSource",
    "Tracer",
    "WorkerState",
]
