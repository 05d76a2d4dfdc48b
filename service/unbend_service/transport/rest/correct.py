"""POST /v1/correct."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request, Response

from unbend_service.application.correction import CorrectOptions
from unbend_service.application.service import Service
from unbend_service.domain import errors
from unbend_service.domain.access import Scope
from unbend_service.domain.fit import Fit
from unbend_service.domain.frames import Border
from unbend_service.domain.records import Correct
from unbend_service.transport.rest import parameters, problems
from unbend_service.transport.rest.bodies import IMAGE_REQUEST_BODY, Bodies
from unbend_service.transport.rest.guards import guarded
from unbend_service.transport.rest.provenance import HEADERS, headers_of

#: What may go wrong whenever a picture is sent.
IMAGE_ERRORS = (
    errors.InvalidInput,
    errors.BodyTooLarge,
    errors.UnsupportedMediaType,
    errors.EmptyBody,
    errors.InvalidImage,
    errors.TooManyPixels,
    errors.InvalidOption,
    errors.ImageTooCostly,
    errors.RequestStalled,
    errors.QueueFull,
    errors.MemoryFull,
    errors.Unavailable,
)
IMAGE_RESPONSE: dict[str, Any] = {
    "description": "The picture; what was decided stands in the headers.",
    "headers": HEADERS,
    "content": {
        f"image/{name}": {"schema": {"type": "string", "format": "binary"}} for name in ("jpeg", "png", "webp")
    },
}


def router(service: Service, bodies: Bodies) -> APIRouter:
    """The route over ``service``."""
    routes = APIRouter(dependencies=guarded(service.access, Scope.CORRECT))

    @routes.post(
        "/v1/correct",
        summary="Straighten a picture",
        response_class=Response,
        responses={
            200: IMAGE_RESPONSE,
            **problems.responses(
                *IMAGE_ERRORS, errors.InvalidGrid, errors.FoldedGrid, errors.GridNotFound, errors.DeadlineExceeded
            ),
        },
        openapi_extra={"requestBody": IMAGE_REQUEST_BODY},
    )
    async def correct(
        request: Request,
        correct: parameters.CorrectQuery = Correct.NONLINEAR,
        fit: parameters.FitQuery = "crop",
        strength: parameters.StrengthQuery = 1.0,
        border: parameters.BorderQuery = "black",
        quality: parameters.QualityQuery = None,
        format: parameters.FormatQuery = None,
        grid_id: parameters.GridIdQuery = None,
        min_confidence: parameters.ConfidenceQuery = None,
        camera: parameters.CameraQuery = None,
    ) -> Response:
        """Send the image file; the straightened picture comes back in the same format, upright, with its EXIF block
        and ICC profile. A picture that has nothing to correct, or whose estimate is not trusted, is left alone."""
        options = CorrectOptions(
            correct=correct,
            fit=Fit.parse(fit),
            strength=strength,
            border=Border.parse(border),
            quality=quality,
            image_format=format,
            grid_id=grid_id,
            min_confidence=min_confidence,
            camera=camera,
        )
        async with bodies.image(request) as body:
            corrected = await service.correction.of_image(body, options)
        headers = headers_of(corrected.record, corrected.record.strength * strength)
        return Response(corrected.body, media_type=f"image/{corrected.image_format}", headers=headers)

    return routes
