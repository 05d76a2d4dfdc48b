"""POST /v1/overlay."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Query, Request, Response

from unbend_service.application.correction import CorrectOptions
from unbend_service.application.exhibit import Subject
from unbend_service.application.illustration import SVG
from unbend_service.application.service import Service
from unbend_service.domain import errors
from unbend_service.domain.access import Scope
from unbend_service.domain.fit import Fit
from unbend_service.domain.records import Correct
from unbend_service.transport.rest import parameters, problems
from unbend_service.transport.rest.bodies import IMAGE_REQUEST_BODY, Bodies
from unbend_service.transport.rest.correct import IMAGE_ERRORS, IMAGE_RESPONSE
from unbend_service.transport.rest.guards import guarded
from unbend_service.transport.rest.provenance import headers_of

SubjectQuery = Annotated[
    Subject,
    Query(
        description="`guides`: the curves that ought to be straight; `grid`: the lattice that becomes regular; "
        "`displacement`: where each part of the picture moves; `magnitude`: how far, as colours with a legend in "
        "pixels; `grids`: the lattice, and the same lattice straight over the corrected picture; `sheet`: before, "
        "after, guides and grid on one sheet."
    ),
]

FigureFormatQuery = Annotated[
    Literal["jpeg", "png", "webp", "svg"] | None,
    Query(description="Format of the figure; that of the body if not given (png for tiff and bmp)."),
]

_SVG_BODY = {"image/svg+xml": {"schema": {"type": "string"}}}
FIGURE_RESPONSE = {**IMAGE_RESPONSE, "content": {**IMAGE_RESPONSE["content"], **_SVG_BODY}}


def router(service: Service, bodies: Bodies) -> APIRouter:
    """The route over ``service``."""
    routes = APIRouter(dependencies=guarded(service.access, Scope.CORRECT))

    @routes.post(
        "/v1/overlay",
        summary="Draw an estimate over its picture",
        response_class=Response,
        responses={
            200: FIGURE_RESPONSE,
            **problems.responses(
                *IMAGE_ERRORS, errors.InvalidGrid, errors.FoldedGrid, errors.GridNotFound, errors.DeadlineExceeded
            ),
        },
        openapi_extra={"requestBody": IMAGE_REQUEST_BODY},
    )
    async def overlay(
        request: Request,
        what: SubjectQuery = Subject.GUIDES,
        correct: parameters.CorrectQuery = Correct.NONLINEAR,
        grid_id: parameters.GridIdQuery = None,
        fit: parameters.FitQuery = "crop",
        format: FigureFormatQuery = None,
    ) -> Response:
        """Send the image file; the distorted picture comes back with the estimate drawn over it.

        `grids` and `sheet` show the corrected picture too, in the frame that `fit` says.
        """
        options = CorrectOptions(correct=correct, fit=Fit.parse(fit), grid_id=grid_id, image_format=format)
        async with bodies.image(request) as body:
            drawn = await service.illustration.of_image(body, what, options)
        headers = headers_of(drawn.record, drawn.record.strength)
        kind = "svg+xml" if drawn.image_format == SVG else drawn.image_format
        return Response(drawn.body, media_type=f"image/{kind}", headers=headers)

    return routes
