"""/v1/grids/{id}/export and /v1/grids/import: grids that travel."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response

from unbend_service.application.service import Service
from unbend_service.domain import errors
from unbend_service.domain.access import Scope
from unbend_service.domain.dense_maps import MAX_MAP_PIXELS
from unbend_service.domain.exchange import Direction, ExportFormat, ExportOptions, ImportFormat, ImportOptions
from unbend_service.domain.fit import Fit
from unbend_service.domain.grid import MAX_POINTS
from unbend_service.transport.rest import parameters, problems
from unbend_service.transport.rest.bodies import Bodies
from unbend_service.transport.rest.grids import UPLOAD_ERRORS
from unbend_service.transport.rest.guards import guarded
from unbend_service.transport.rest.provenance import GridRecordBody, json_of

_MAP_SIDE_PX = 1 << 16
SizeQuery = Annotated[
    int | None,
    Query(
        ge=1,
        le=_MAP_SIDE_PX,
        description=f"Pixels of both pictures; needed by all formats but json; {MAX_MAP_PIXELS} pixels in all at most.",
    ),
]
DirectionQuery = Annotated[
    Direction,
    Query(description="`undistort`: the map that draws the straight picture; `redistort`: the bent one from it."),
]
ExportQuery = Annotated[
    ExportFormat,
    Query(
        description="`json`: the record; `npz`: `map_x` and `map_y` for cv2.remap, float32; `npz-fixed`: `map_1` and "
        "`map_2`, CV_16SC2; `stmap-exr`, `stmap-tiff`: 32-bit float, R = u, G = v upwards, 0..1; `ffmpeg`: a zip with "
        "the PGM pair of its remap filter and the command line."
    ),
]
ImportQuery = Annotated[
    ImportFormat,
    Query(
        description="`json`: a grid or guides; `npz`: OpenCV maps, float or fixed point; `stmap-exr`, `stmap-tiff`; "
        "`opencv`: camera matrix and distortion coefficients, JSON or YAML; `lensfun`: JSON that names a profile."
    ),
]
PointsQuery = Annotated[
    int, Query(ge=2, le=MAX_POINTS, description="Rows and columns of the grid that is made; json keeps its own.")
]
_BINARY = {"schema": {"type": "string", "format": "binary"}}
_FILE: dict[str, Any] = {
    "description": "The file.",
    "content": {
        "application/json": {"schema": {"$ref": "#/components/schemas/GridRecordBody"}},
        **dict.fromkeys(("application/zip", "image/x-exr", "image/tiff"), _BINARY),
    },
}
_UPLOAD: dict[str, Any] = {
    "required": True,
    "description": "The file as it is.",
    "content": {"application/octet-stream": _BINARY},
}


def router(service: Service, bodies: Bodies) -> APIRouter:
    """The routes over ``service``."""
    routes = APIRouter(prefix="/v1/grids", dependencies=guarded(service.access, Scope.GRIDS))

    @routes.get(
        "/{grid_id}/export",
        summary="Export a grid",
        response_class=Response,
        responses={
            200: _FILE,
            **problems.responses(
                errors.GridNotFound,
                errors.InvalidOption,
                errors.InvalidGrid,
                errors.FoldedGrid,
                errors.QueueFull,
                errors.Unavailable,
            ),
        },
    )
    async def export(
        grid_id: parameters.GridIdPath,
        format: ExportQuery = ExportFormat.JSON,
        width: SizeQuery = None,
        height: SizeQuery = None,
        direction: DirectionQuery = Direction.UNDISTORT,
        fit: parameters.FitQuery = "keep",
        strength: parameters.StrengthQuery = 1.0,
    ) -> Response:
        """For programs that do not speak grids."""
        options = ExportOptions(width, height, direction, Fit.parse(fit), strength)
        record = await service.grids.get(grid_id)
        file = await service.exchange.export(record, format, options)
        name = record.id
        if format is not ExportFormat.JSON:
            name += f"-{width}x{height}"
        if direction is Direction.REDISTORT:
            name += "-redistort"
        headers = {"Content-Disposition": f'attachment; filename="{name}{file.suffix}"'}
        return Response(file.body, media_type=file.media_type, headers=headers)

    @routes.post(
        "/import",
        summary="Import a grid",
        status_code=201,
        response_class=Response,
        responses={
            201: {"model": GridRecordBody, "description": "Stored; Location says where."},
            **problems.responses(*UPLOAD_ERRORS, errors.InvalidOption),
        },
        openapi_extra={"requestBody": _UPLOAD},
    )
    async def read(
        request: Request,
        format: ImportQuery,
        direction: DirectionQuery = Direction.UNDISTORT,
        points: PointsQuery = 129,
    ) -> Response:
        """From a file of another program; `direction` says which picture its map draws."""
        async with bodies.raw(request) as body:
            read = await service.exchange.read(body, format, ImportOptions(direction, points))
        record = await service.grids.put_record(read)
        return json_of(record, 201, {"Location": f"/v1/grids/{record.id}"})

    return routes
