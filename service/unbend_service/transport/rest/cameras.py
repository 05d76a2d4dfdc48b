"""/v1/cameras: what is remembered of the cameras that pictures named."""

from __future__ import annotations

from fastapi import APIRouter, Response
from pydantic import BaseModel, Field

from unbend_service.application.cameras import Cameras
from unbend_service.application.service import Service
from unbend_service.domain import errors
from unbend_service.domain.access import Scope
from unbend_service.domain.camera_record import CameraRecord
from unbend_service.transport.rest import parameters, problems
from unbend_service.transport.rest.guards import guarded

_PIXELS = 128.0
"""Pixels of a picture that is 256 wide, per half picture width."""


class CameraBody(BaseModel):
    """What the pictures of a camera said so far."""

    camera: str
    version: int = Field(description="Grows with every picture that changed something, and when it begins anew.")
    pictures: int = Field(description="Pictures that were looked at.")
    agreeing: int = Field(description="Those that were not far off.")
    locked: bool = Field(description="Further pictures change nothing: all get the same grid.")
    confidence: float
    expected_error_px: float = Field(description="Expected error, pixels of a picture that is 256 wide.")
    aspect: float = Field(description="Width over height of its pictures.")
    model: str


def router(service: Service) -> APIRouter:
    """The routes over ``service``."""
    cameras: Cameras = service.estimation.cameras
    routes = APIRouter(prefix="/v1/cameras", dependencies=guarded(service.access, Scope.GRIDS))

    @routes.get(
        "/{name:path}",
        summary="What is known of a camera",
        responses=problems.responses(errors.GridNotFound, errors.InvalidOption, errors.Unavailable),
    )
    async def get(name: parameters.CameraPath) -> CameraBody:
        """Of pictures that were sent with `camera`."""
        return _body(name, await cameras.get(name))

    @routes.delete(
        "/{name:path}",
        summary="Forget a camera",
        status_code=204,
        response_class=Response,
        responses=problems.responses(errors.GridNotFound, errors.InvalidOption, errors.Unavailable),
    )
    async def delete(name: parameters.CameraPath) -> Response:
        """The next picture that names it begins anew: after a change of lens, zoom or focus."""
        await cameras.reset(name)
        return Response(status_code=204)

    return routes


def _body(name: str, record: CameraRecord) -> CameraBody:
    return CameraBody(
        camera=name,
        version=record.version,
        pictures=len(record.looks),
        agreeing=record.fused.agreeing,
        locked=record.is_locked,
        confidence=record.fused.confidence,
        expected_error_px=record.fused.expected_error * _PIXELS,
        aspect=record.aspect,
        model=record.model,
    )
