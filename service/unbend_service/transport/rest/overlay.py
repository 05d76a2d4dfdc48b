"""POST /v1/overlay."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from unbend_service.application.illustration import Subject
from unbend_service.application.service import Service
from unbend_service.domain import errors
from unbend_service.domain.records import Correct
from unbend_service.transport.rest import parameters, problems
from unbend_service.transport.rest.bodies import IMAGE_REQUEST_BODY, Bodies
from unbend_service.transport.rest.correct import IMAGE_ERRORS, IMAGE_RESPONSE
from unbend_service.transport.rest.provenance import headers_of

SubjectQuery = Annotated[
    Subject,
    Query(
        description="`guides`: the curves that ought to be straight; `grid`: the lattice that becomes regular; "
        "`displacement`: where each part of the picture moves."
    ),
]


def router(service: Service, bodies: Bodies) -> APIRouter:
    """The route over ``service``."""
    routes = APIRouter()

    @routes.post(
        "/v1/overlay",
        summary="Draw an estimate over its picture",
        response_class=Response,
        responses={
            200: IMAGE_RESPONSE,
            **problems.responses(*IMAGE_ERRORS, errors.InvalidGrid, errors.GridNotFound),
        },
        openapi_extra={"requestBody": IMAGE_REQUEST_BODY},
    )
    async def overlay(
        request: Request,
        what: SubjectQuery = Subject.GUIDES,
        correct: parameters.CorrectQuery = Correct.NONLINEAR,
        grid_id: parameters.GridIdQuery = None,
        format: parameters.FormatQuery = None,
    ) -> Response:
        """Send the image file; the distorted picture comes back with the estimate drawn over it."""
        async with bodies.image(request) as body:
            drawn = await service.illustration.of_image(body, what, correct, grid_id=grid_id, image_format=format)
        headers = headers_of(drawn.record, drawn.record.strength)
        return Response(drawn.body, media_type=f"image/{drawn.image_format}", headers=headers)

    return routes
