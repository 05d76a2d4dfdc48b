"""Unary calls without their input and output: what is sent, how the answer is read, whether it may be sent again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt
from google.protobuf.message import Message

from unbend import _types as types
from unbend._errors import InvalidOption, ServerFault
from unbend._images import ENCODED, FORMATS, Packed, pack, unpack
from unbend.v1 import correction_pb2, estimation_pb2, frame_pb2, grid_pb2

T = TypeVar("T")

CORRECTS = {"nonlinear": grid_pb2.CORRECT_NONLINEAR, "all": grid_pb2.CORRECT_ALL}
OUTCOMES = {grid_pb2.OUTCOME_CORRECTED: types.Outcome.CORRECTED, grid_pb2.OUTCOME_LEFT_ALONE: types.Outcome.LEFT_ALONE}

#: What may stand for a grid.
GridLike = str | types.GridRecord | types.Estimate | types.Correction | types.Grid | types.Guides


@dataclass(frozen=True, slots=True)
class Call(Generic[T]):
    """One unary call.

    Attributes:
        method: full name on the wire.
        request: the message to be sent.
        answer: type of the message that comes back.
        parse: reads it.
        repeatable: whether sending it twice does no more than sending it once.
    """

    method: str
    request: Message
    answer: type[Message]
    parse: Callable[[Any], T]
    repeatable: bool = True


def serialize(message: Message) -> bytes:
    """The message as it travels."""
    return message.SerializeToString()


def correct_call(
    image: types.Image,
    grid_id: str | None,
    *,
    pixel_format: str | None = None,
    correct: str = "nonlinear",
    fit: str | float = "crop",
    strength: float = 1.0,
    border: types.Border | None = None,
    quality: int | None = None,
    answer_format: str | None = None,
    min_confidence: float | None = None,
    camera: str = "",
) -> Call[types.Correction]:
    """Raises InvalidInput for what cannot be sent."""
    packed = pack(image, pixel_format)
    request = correction_pb2.CorrectRequest(
        format=packed.layout,
        data=packed.data,
        correct=to_correct(correct),
        rendering=to_rendering(fit, strength, border, quality),
        grid_id=grid_id or "",
        min_confidence=min_confidence,
        camera=camera,
    )
    if answer_format is not None:
        if answer_format not in ENCODED:
            raise InvalidOption(f"answer_format={answer_format!r} is not known.", allowed=", ".join(ENCODED))
        request.answer_format = FORMATS[answer_format]

    def parse(answer: correction_pb2.CorrectResponse) -> types.Correction:
        name = answer_format or next(name for name, number in FORMATS.items() if number == packed.layout.pixel_format)
        before = packed.data if packed.shape is None else np.frombuffer(packed.data, np.uint8).reshape(packed.shape)
        return types.Correction(_image(answer.data, packed), from_record(answer.record), name, before)

    return Call("/unbend.v1.CorrectionService/Correct", request, correction_pb2.CorrectResponse, parse)


def estimate_call(
    image: types.Image,
    *,
    pixel_format: str | None = None,
    correct: str = "nonlinear",
    fit: str | float = "keep",
    strength: float = 1.0,
    min_confidence: float | None = None,
    camera: str = "",
) -> Call[types.Estimate]:
    """Raises InvalidInput for what cannot be sent."""
    packed = pack(image, pixel_format)
    request = estimation_pb2.EstimateRequest(
        format=packed.layout,
        data=packed.data,
        correct=to_correct(correct),
        fit=str(fit),
        strength=strength,
        min_confidence=min_confidence,
        camera=camera,
    )

    def parse(answer: estimation_pb2.EstimateResponse) -> types.Estimate:
        return types.Estimate(from_record(answer.record))

    return Call("/unbend.v1.EstimationService/Estimate", request, estimation_pb2.EstimateResponse, parse)


def get_grid_call(grid_id: str) -> Call[types.GridRecord]:
    return Call(
        "/unbend.v1.GridService/GetGrid",
        grid_pb2.GetGridRequest(grid_id=grid_id),
        grid_pb2.GetGridResponse,
        lambda answer: from_record(answer.record),
    )


def put_grid_call(content: types.Grid | types.Guides) -> Call[types.GridRecord]:
    """Repeatable: the id is derived from the content."""
    if isinstance(content, types.Guides):
        request = grid_pb2.PutGridRequest(guides=to_guides(content))
    else:
        source = content.source.ravel().tolist()
        grid = grid_pb2.Grid(rows=content.rows, columns=content.columns, source=source)
        request = grid_pb2.PutGridRequest(grid=grid)
    return Call(
        "/unbend.v1.GridService/PutGrid", request, grid_pb2.PutGridResponse, lambda answer: from_record(answer.record)
    )


def delete_grid_call(grid_id: str) -> Call[None]:
    """Not repeatable: a second deletion would not find the grid."""
    return Call(
        "/unbend.v1.GridService/DeleteGrid",
        grid_pb2.DeleteGridRequest(grid_id=grid_id),
        grid_pb2.DeleteGridResponse,
        lambda _: None,
        repeatable=False,
    )


def to_correct(correct: str) -> grid_pb2.Correct.ValueType:
    """Raises InvalidOption."""
    if correct not in CORRECTS:
        raise InvalidOption(f"correct={correct!r} is not known.", allowed=", ".join(CORRECTS))
    return CORRECTS[correct]


def to_rendering(
    fit: str | float, strength: float, border: types.Border | None, quality: int | None
) -> frame_pb2.Rendering:
    """Raises InvalidOption."""
    if quality is not None and not 1 <= quality <= 100:
        raise InvalidOption(f"quality={quality} is out of range.", allowed="1..100")
    message = None
    if border is not None:
        samples = border.red, border.green, border.blue, border.alpha
        if not all(0 <= sample <= 255 for sample in samples):
            raise InvalidOption(f"{border} is out of range.", allowed="0..255")
        red, green, blue, alpha = samples
        message = frame_pb2.Border(red=red, green=green, blue=blue, alpha=alpha)
    return frame_pb2.Rendering(fit=str(fit), strength=strength, border=message, quality=quality or 0)


def to_guides(guides: types.Guides) -> grid_pb2.Guides:
    rows, columns = (
        [grid_pb2.Guide(anchor=guide.anchor, coefficients=guide.coefficients) for guide in family]
        for family in (guides.rows, guides.columns)
    )
    return grid_pb2.Guides(rows=rows, columns=columns)


def grid_id_of(grid: GridLike | None) -> str | None:
    """The id that a grid is known by; None for content that has to be stored first, and for none."""
    if isinstance(grid, str):
        return grid
    if isinstance(grid, types.GridRecord | types.Estimate | types.Correction):
        return grid.grid_id
    return None


def from_record(message: grid_pb2.GridRecord) -> types.GridRecord:
    if message.outcome not in OUTCOMES:
        raise ServerFault(f"The server answered with the outcome {message.outcome}, which is not known here.")
    grid = None
    if message.HasField("grid"):
        shape = message.grid.rows, message.grid.columns, 2
        grid = types.Grid(np.array(message.grid.source, dtype=np.float32).reshape(shape))
    return types.GridRecord(
        grid_id=message.grid_id,
        confidence=message.confidence,
        confidence_kind=message.confidence_kind,
        outcome=OUTCOMES[message.outcome],
        reason=message.reason,
        strength=message.strength,
        model=message.model,
        grid=grid,
        guides=_from_guides(message.guides) if message.HasField("guides") else None,
    )


def _from_guides(message: grid_pb2.Guides) -> types.Guides:
    rows, columns = (
        tuple(types.Guide(guide.anchor, tuple(guide.coefficients)) for guide in family)
        for family in (message.rows, message.columns)
    )
    return types.Guides(rows, columns)


def _image(data: bytes, packed: Packed) -> npt.NDArray[np.uint8] | bytes:
    if packed.shape is not None and len(data) != len(packed.data):
        raise ServerFault(f"The server answered a picture of {len(packed.data)} bytes with {len(data)} bytes.")
    return unpack(data, packed)
