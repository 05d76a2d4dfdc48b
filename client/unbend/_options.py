"""The keyword arguments of :class:`unbend.Client`, for the asynchronous face that takes the same ones."""

from __future__ import annotations

from typing import TypedDict

from unbend import _types as types


class EstimateOptions(TypedDict, total=False):
    """As of :meth:`unbend.Client.estimate`."""

    pixel_format: str | None
    correct: str
    fit: str | float
    strength: float
    min_confidence: float | None
    camera: str


class CorrectOptions(EstimateOptions, total=False):
    """As of :meth:`unbend.Client.correct`, without ``grid``."""

    border: types.Border | None
    quality: int | None
    answer_format: str | None


class StreamKeywords(TypedDict, total=False):
    """As of :meth:`unbend.Client.stream`."""

    stream_id: str | None
    correct: str
    fit: str | float
    strength: float
    border: types.Border | None
    quality: int | None
    grid: str | types.GridRecord | types.Estimate | types.Guides | None
    frames: int | None
    while_estimating: str
    delivery: str
    min_confidence: float | None
    estimate_again: bool
    in_flight: int
    reconnects: int
    frame_deadline_s: float | None
