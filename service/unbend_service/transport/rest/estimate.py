"""POST /v1/estimate."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response

from unbend_service.application.service import Service
from unbend_service.domain import errors
from unbend_service.domain.access import Scope
from unbend_service.domain.fit import Fit
from unbend_service.domain.records import Correct
from unbend_service.transport.rest import parameters, problems
from unbend_service.transport.rest.bodies import IMAGE_REQUEST_BODY, Bodies
from unbend_service.transport.rest.correct import IMAGE_ERRORS
from unbend_service.transport.rest.guards import guarded
from unbend_service.transport.rest.provenance import GridRecordBody, json_of


def router(service: Service, bodies: Bodies) -> APIRouter:
    """The route over ``service``."""
    routes = APIRouter(dependencies=guarded(service.access, Scope.CORRECT))

    @routes.post(
        "/v1/estimate",
        summary="Estimate the distortion of a picture",
        response_class=Response,
        responses={
            200: {"model": GridRecordBody, "description": "The grid that straightens the picture, and its guides."},
            **problems.responses(*IMAGE_ERRORS, errors.InvalidGrid, errors.FoldedGrid, errors.InvalidGuides),
        },
        openapi_extra={"requestBody": IMAGE_REQUEST_BODY},
    )
    async def estimate(
        request: Request,
        correct: parameters.CorrectQuery = Correct.NONLINEAR,
        fit: parameters.FitQuery = "keep",
        strength: parameters.StrengthQuery = 1.0,
        min_confidence: parameters.ConfidenceQuery = None,
        camera: parameters.CameraQuery = None,
    ) -> Response:
        """Send the image file. The grid that comes back, and is stored under `grid_id`, is the one that `correct`,
        `fit` and `strength` describe; the guides are as estimated."""
        wanted = Fit.parse(fit)
        async with bodies.image(request) as body:
            record = await service.estimation.of_image(body, correct, wanted, strength, min_confidence, camera)
        return json_of(record)

    return routes
