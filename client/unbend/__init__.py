"""The client of Unbend, which straightens photographs and video from unknown cameras.

>>> import numpy as np, unbend
>>> with unbend.Client("127.0.0.1:50051") as client:
...     corrected = client.correct(np.zeros((480, 640, 3), np.uint8)).image

Needs numpy, grpcio and protobuf, which are loaded when the first name is used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from unbend._async_client import AsyncClient as AsyncClient
    from unbend._async_client import AsyncGrids as AsyncGrids
    from unbend._async_stream import AsyncStream as AsyncStream
    from unbend._client import Client as Client
    from unbend._client import Grids as Grids
    from unbend._errors import BodyTooLarge as BodyTooLarge
    from unbend._errors import Closed as Closed
    from unbend._errors import DeadlineExceeded as DeadlineExceeded
    from unbend._errors import Draining as Draining
    from unbend._errors import EmptyBody as EmptyBody
    from unbend._errors import EstimatorUnavailable as EstimatorUnavailable
    from unbend._errors import FoldedGrid as FoldedGrid
    from unbend._errors import GridConflict as GridConflict
    from unbend._errors import GridNotFound as GridNotFound
    from unbend._errors import GridStoreUnavailable as GridStoreUnavailable
    from unbend._errors import ImageTooCostly as ImageTooCostly
    from unbend._errors import InvalidFrame as InvalidFrame
    from unbend._errors import InvalidGrid as InvalidGrid
    from unbend._errors import InvalidGuides as InvalidGuides
    from unbend._errors import InvalidImage as InvalidImage
    from unbend._errors import InvalidInput as InvalidInput
    from unbend._errors import InvalidOption as InvalidOption
    from unbend._errors import InvalidRegion as InvalidRegion
    from unbend._errors import MemoryFull as MemoryFull
    from unbend._errors import MissingPackage as MissingPackage
    from unbend._errors import ModelUnavailable as ModelUnavailable
    from unbend._errors import NotServedHere as NotServedHere
    from unbend._errors import Overloaded as Overloaded
    from unbend._errors import PermissionDenied as PermissionDenied
    from unbend._errors import PoisonFrame as PoisonFrame
    from unbend._errors import ProtocolViolation as ProtocolViolation
    from unbend._errors import QueueFull as QueueFull
    from unbend._errors import RateLimited as RateLimited
    from unbend._errors import Refused as Refused
    from unbend._errors import RegionNotFound as RegionNotFound
    from unbend._errors import RendererUnavailable as RendererUnavailable
    from unbend._errors import RenderFailed as RenderFailed
    from unbend._errors import RequestStalled as RequestStalled
    from unbend._errors import ServerFault as ServerFault
    from unbend._errors import StreamEnded as StreamEnded
    from unbend._errors import StreamIdle as StreamIdle
    from unbend._errors import StreamTakenOver as StreamTakenOver
    from unbend._errors import TooManyPixels as TooManyPixels
    from unbend._errors import TooManyRegions as TooManyRegions
    from unbend._errors import TooManyStreams as TooManyStreams
    from unbend._errors import Unauthenticated as Unauthenticated
    from unbend._errors import Unavailable as Unavailable
    from unbend._errors import UnbendError as UnbendError
    from unbend._errors import Unreachable as Unreachable
    from unbend._errors import UnsupportedMediaType as UnsupportedMediaType
    from unbend._errors import UnsupportedPixelFormat as UnsupportedPixelFormat
    from unbend._stream import Stream as Stream
    from unbend._types import Border as Border
    from unbend._types import Correction as Correction
    from unbend._types import Estimate as Estimate
    from unbend._types import FrameStatus as FrameStatus
    from unbend._types import Grid as Grid
    from unbend._types import GridRecord as GridRecord
    from unbend._types import Guide as Guide
    from unbend._types import Guides as Guides
    from unbend._types import Image as Image
    from unbend._types import Outcome as Outcome
    from unbend._types import StreamResult as StreamResult

#: Where each public name lives.
_HOMES = {
    "_async_client": ("AsyncClient", "AsyncGrids"),
    "_async_stream": ("AsyncStream",),
    "_client": ("Client", "Grids"),
    "_errors": (
        "BodyTooLarge",
        "Closed",
        "DeadlineExceeded",
        "Draining",
        "EmptyBody",
        "EstimatorUnavailable",
        "FoldedGrid",
        "GridConflict",
        "GridNotFound",
        "GridStoreUnavailable",
        "ImageTooCostly",
        "InvalidFrame",
        "InvalidGrid",
        "InvalidGuides",
        "InvalidImage",
        "InvalidInput",
        "InvalidOption",
        "MemoryFull",
        "InvalidRegion",
        "MissingPackage",
        "ModelUnavailable",
        "NotServedHere",
        "Overloaded",
        "PermissionDenied",
        "PoisonFrame",
        "ProtocolViolation",
        "QueueFull",
        "RateLimited",
        "Refused",
        "RegionNotFound",
        "RenderFailed",
        "RendererUnavailable",
        "RequestStalled",
        "ServerFault",
        "StreamEnded",
        "StreamIdle",
        "StreamTakenOver",
        "TooManyPixels",
        "TooManyRegions",
        "TooManyStreams",
        "Unauthenticated",
        "Unavailable",
        "UnbendError",
        "Unreachable",
        "UnsupportedMediaType",
        "UnsupportedPixelFormat",
    ),
    "_stream": ("Stream",),
    "_types": (
        "Border",
        "Correction",
        "Estimate",
        "FrameStatus",
        "Grid",
        "GridRecord",
        "Guide",
        "Guides",
        "Image",
        "Outcome",
        "StreamResult",
    ),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}
__all__ = sorted(_HOME_OF)


def __getattr__(name: str) -> Any:
    home = _HOME_OF.get(name)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{home}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*globals(), *__all__]
