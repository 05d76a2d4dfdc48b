"""Query parameters, each with its range as OpenAPI shows it."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import Path, Query, Request
from pydantic import WithJsonSchema

from unbend_service.domain.errors import InvalidOption
from unbend_service.domain.frames import BORDER_PATTERN, BORDERS_ALLOWED
from unbend_service.domain.records import Correct

CorrectQuery = Annotated[
    Correct,
    Query(
        description="`nonlinear` straightens lines and keeps framing, tilt and perspective; `all` undoes rotation, "
        "shear and perspective too."
    ),
]
FitQuery = Annotated[
    str,
    WithJsonSchema(
        {
            "anyOf": [
                {"type": "string", "enum": ["keep", "crop", "full"]},
                {"type": "number", "minimum": 0, "maximum": 1},
            ]
        }
    ),
    Query(
        description="`keep`: the frame as estimated; `crop`: the largest part without invalid pixels; `full`: every "
        "source pixel; or a number between crop (0) and full (1)."
    ),
]
StrengthQuery = Annotated[
    float, Query(ge=0, le=1, allow_inf_nan=False, description="Share of the correction that is applied.")
]
ConfidenceQuery = Annotated[
    float | None,
    Query(
        ge=0,
        le=1,
        allow_inf_nan=False,
        description="Below this confidence the picture is left alone, from it on corrected all the way; if not given "
        "the setting `min_confidence`, or what the model advises: in doubt, a little.",
    ),
]
BorderQuery = Annotated[
    str,
    WithJsonSchema({"type": "string", "maxLength": 16, "pattern": BORDER_PATTERN}),
    Query(max_length=16, description=f"What is painted where there is no picture: {BORDERS_ALLOWED}."),
]
QualityQuery = Annotated[
    int | None,
    Query(ge=1, le=100, description="Of jpeg and webp; the setting `jpeg_quality` if not given."),
]
FormatQuery = Annotated[
    Literal["jpeg", "png", "webp"] | None,
    Query(description="Format of the answer; that of the body if not given (png for tiff and bmp)."),
]
GridIdQuery = Annotated[
    str | None,
    Query(min_length=1, max_length=128, description="Id of a stored grid, used instead of an estimate."),
]
CameraQuery = Annotated[
    str | None,
    Query(
        min_length=1,
        max_length=128,
        description="Whose picture it is. What pictures of one camera say of its lens adds up, until it is known well "
        "enough and locks. `exif` takes make, model, lens and focal length from the file, if it names them.",
    ),
]
CameraPath = Annotated[str, Path(max_length=128, description="The name that pictures gave their camera.")]
GridIdPath = Annotated[str, Path(max_length=128, description="The id that the content gives the grid.")]


async def refuse_unknown(request: Request) -> None:
    """A misspelt parameter is answered with the names that are known, rather than ignored."""
    dependant = getattr(request.scope.get("route"), "dependant", None)
    known = [parameter.alias for parameter in dependant.query_params] if dependant is not None else []
    unknown = sorted(set(request.query_params) - set(known))
    if unknown:
        raise InvalidOption(
            f"Unknown query parameter {', '.join(unknown)}.", allowed=", ".join(known) or "no parameters"
        )
