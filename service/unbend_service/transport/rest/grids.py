"""/v1/grids: the grid library."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request, Response

from unbend_service.application.service import Service
from unbend_service.domain import errors
from unbend_service.domain.access import Scope
from unbend_service.transport.rest import parameters, problems
from unbend_service.transport.rest.bodies import Bodies, parse_json
from unbend_service.transport.rest.guards import guarded
from unbend_service.transport.rest.provenance import GridBody, GridRecordBody, GuidesBody, json_of

_UPLOAD: dict[str, Any] = {
    "required": True,
    "description": "`grid`, with whatever else an estimate says of it; or `guides` alone, and the grid is spun here.",
    "content": {
        "application/json": {
            "schema": {
                "type": "object",
                "properties": {
                    "grid": {"$ref": "#/components/schemas/GridBody"},
                    "guides": {"$ref": "#/components/schemas/GuidesBody"},
                },
                "anyOf": [{"required": ["grid"]}, {"required": ["guides"]}],
            }
        }
    },
}
UPLOAD_ERRORS = (
    errors.BodyTooLarge,
    errors.InvalidGrid,
    errors.FoldedGrid,
    errors.InvalidGuides,
    errors.RequestStalled,
    errors.QueueFull,
    errors.MemoryFull,
    errors.Unavailable,
)
#: Named in OpenAPI though no route takes them as parsed models: large grids are parsed by orjson alone.
COMPONENTS = (GridBody, GuidesBody)


def router(service: Service, bodies: Bodies) -> APIRouter:
    """The routes over ``service``."""
    routes = APIRouter(prefix="/v1/grids", dependencies=guarded(service.access, Scope.GRIDS))

    async def read_json(request: Request) -> Any:
        async with bodies.raw(request) as body:
            return await service.blocking.run("grid", parse_json, body)

    @routes.post(
        "",
        summary="Store a grid",
        status_code=201,
        response_class=Response,
        responses={
            201: {"model": GridRecordBody, "description": "Stored; Location says where."},
            **problems.responses(*UPLOAD_ERRORS),
        },
        openapi_extra={"requestBody": _UPLOAD},
    )
    async def post(request: Request) -> Response:
        """The id is computed from the content."""
        record = await service.grids.put(await read_json(request))
        return json_of(record, 201, {"Location": f"/v1/grids/{record.id}"})

    @routes.put(
        "/{grid_id}",
        summary="Store a grid whose id is known",
        response_class=Response,
        responses={
            200: {"model": GridRecordBody, "description": "Stored."},
            **problems.responses(*UPLOAD_ERRORS, errors.GridConflict),
        },
        openapi_extra={"requestBody": _UPLOAD},
    )
    async def put(request: Request, grid_id: parameters.GridIdPath) -> Response:
        """The id must be that of the content: what was fetched from one service can be put into another."""
        return json_of(await service.grids.put(await read_json(request), grid_id))

    @routes.get(
        "/{grid_id}",
        summary="Fetch a grid",
        response_class=Response,
        responses={
            200: {"model": GridRecordBody, "description": "The grid and its provenance."},
            **problems.responses(errors.GridNotFound, errors.InvalidOption, errors.Unavailable),
        },
    )
    async def get(grid_id: parameters.GridIdPath) -> Response:
        """As it was estimated or stored."""
        return json_of(await service.grids.get(grid_id))

    @routes.delete(
        "/{grid_id}",
        summary="Forget a grid",
        status_code=204,
        response_class=Response,
        responses=problems.responses(errors.GridNotFound, errors.InvalidOption, errors.Unavailable),
    )
    async def delete(grid_id: parameters.GridIdPath) -> Response:
        """Streams that were given it estimate anew when they are resumed."""
        await service.grids.delete(grid_id)
        return Response(status_code=204)

    return routes
