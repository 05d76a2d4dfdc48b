"""What was decided about a picture, on the wire: response headers and the JSON of a grid record."""

from __future__ import annotations

from typing import Any, Literal

from fastapi import Response
from pydantic import BaseModel, ConfigDict, Field

from unbend_service.application.record_json import record_json
from unbend_service.domain.records import GridRecord

_TEXT = {"type": "string"}
_SHARE = {"type": "number", "minimum": 0, "maximum": 1}
#: For OpenAPI.
HEADERS: dict[str, Any] = {
    "Unbend-Grid-Id": {"description": "Id under which the grid is stored.", "schema": _TEXT},
    "Unbend-Confidence": {"description": "Confidence of the estimate.", "schema": _SHARE},
    "Unbend-Confidence-Kind": {"description": "What the confidence means.", "schema": _TEXT},
    "Unbend-Outcome": {
        "description": "Whether the picture was changed.",
        "schema": {"type": "string", "enum": ["corrected", "left_alone"]},
    },
    "Unbend-Reason": {"description": "Why it was left alone or corrected less; absent otherwise.", "schema": _TEXT},
    "Unbend-Strength": {"description": "Share of the estimated correction that was applied.", "schema": _SHARE},
    "Unbend-Model": {"description": "The network that estimated; absent for grids from elsewhere.", "schema": _TEXT},
}


def headers_of(record: GridRecord, strength: float) -> dict[str, str]:
    """The ``Unbend-`` headers; ``strength`` is the share that was applied in the end."""
    headers = {
        "Unbend-Grid-Id": record.id,
        "Unbend-Confidence": f"{record.confidence:.4f}",
        "Unbend-Confidence-Kind": record.confidence_kind,
        "Unbend-Outcome": record.outcome.value,
        "Unbend-Reason": record.reason.value,
        "Unbend-Strength": f"{strength:g}",
        "Unbend-Model": record.model,
    }
    return {name: _printable(value) for name, value in headers.items() if value}


def _printable(value: str) -> str:
    """Uploaded records carry texts of their sender; a header takes visible ASCII only."""
    return "".join(c if " " <= c <= "~" else "?" for c in value)[:200]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", protected_namespaces=())


class GuideBody(_Model):
    """A polynomial, and where it lies once straight; centred coordinates."""

    anchor: float = Field(gt=-1, lt=1, description="Target coordinate of the straight line.")
    coefficients: list[float] = Field(
        min_length=2, max_length=16, description="c0, c1, ...: of a row guide y = c0 + c1 x + ..., in the source."
    )


class GuidesBody(_Model):
    """Row and column guides."""

    rows: list[GuideBody] = Field(min_length=2, max_length=32)
    columns: list[GuideBody] = Field(min_length=2, max_length=32)


class GridBody(_Model):
    """A lattice of centred source points for a regular lattice over the target."""

    rows: int = Field(ge=2, le=1025)
    columns: int = Field(ge=2, le=1025)
    source: list[tuple[float, float]] = Field(
        description="rows x columns points [x, y], row after row; [-1, 1] spans the picture, x to the right, y down."
    )


class GridRecordBody(_Model):
    """A grid and its provenance."""

    grid_id: str = Field(description="Derived from the content of the grid.")
    confidence: float = Field(ge=0, le=1)
    confidence_kind: str = Field(
        description="`mirror_agreement`, `calibrated_probability`, or `given` for grids that were not estimated."
    )
    outcome: Literal["corrected", "left_alone"]
    reason: Literal["", "low_confidence", "nothing_to_correct", "folded"]
    strength: float = Field(ge=0, le=1, description="Share of the estimated correction that is in the grid.")
    guides: GuidesBody | None = Field(description="The guides it was spun from; null for grids from elsewhere.")
    grid: GridBody
    model: str = Field(description="The network that estimated; empty for grids from elsewhere.")


def json_of(record: GridRecord, status: int = 200, headers: dict[str, str] | None = None) -> Response:
    """The record as JSON, in the shape of :class:`GridRecordBody`."""
    return Response(record_json(record), status, media_type="application/json", headers=headers)
