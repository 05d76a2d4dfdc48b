"""Messages of ``unbend.v1`` to what the application speaks, and back. Enum tables are total: a test walks them."""

from __future__ import annotations

import numpy as np

from unbend.v1 import correction_pb2, frame_pb2, grid_pb2
from unbend_service.application.correction import CorrectOptions
from unbend_service.application.stream_messages import Delivery, FrameStatus, StreamResult, WhileEstimating
from unbend_service.domain.errors import InvalidGrid, InvalidGuides, InvalidOption, UnsupportedPixelFormat
from unbend_service.domain.fit import Fit
from unbend_service.domain.frames import BLACK, Border, Frame, PixelFormat
from unbend_service.domain.grid import Grid
from unbend_service.domain.guides import GuideFamily, Guides
from unbend_service.domain.records import Correct, GridRecord, Outcome

RAW_FORMATS: dict[int, PixelFormat] = {
    frame_pb2.PIXEL_FORMAT_GRAY8: PixelFormat.GRAY8,
    frame_pb2.PIXEL_FORMAT_RGB24: PixelFormat.RGB24,
    frame_pb2.PIXEL_FORMAT_BGR24: PixelFormat.BGR24,
    frame_pb2.PIXEL_FORMAT_RGBA: PixelFormat.RGBA,
    frame_pb2.PIXEL_FORMAT_BGRA: PixelFormat.BGRA,
    frame_pb2.PIXEL_FORMAT_I420: PixelFormat.I420,
    frame_pb2.PIXEL_FORMAT_NV12: PixelFormat.NV12,
}
ENCODED_FORMATS: dict[int, str] = {
    frame_pb2.PIXEL_FORMAT_JPEG: "jpeg",
    frame_pb2.PIXEL_FORMAT_PNG: "png",
    frame_pb2.PIXEL_FORMAT_WEBP: "webp",
}
CORRECTS: dict[int, Correct] = {
    grid_pb2.CORRECT_UNSPECIFIED: Correct.NONLINEAR,
    grid_pb2.CORRECT_NONLINEAR: Correct.NONLINEAR,
    grid_pb2.CORRECT_ALL: Correct.ALL,
}
WHILE_ESTIMATING: dict[int, WhileEstimating] = {
    correction_pb2.WHILE_ESTIMATING_UNSPECIFIED: WhileEstimating.HOLD,
    correction_pb2.WHILE_ESTIMATING_HOLD: WhileEstimating.HOLD,
    correction_pb2.WHILE_ESTIMATING_PASS_THROUGH: WhileEstimating.PASS_THROUGH,
}
DELIVERIES: dict[int, Delivery] = {
    correction_pb2.DELIVERY_UNSPECIFIED: Delivery.LOSSLESS,
    correction_pb2.DELIVERY_LOSSLESS: Delivery.LOSSLESS,
    correction_pb2.DELIVERY_LATEST: Delivery.LATEST,
}
OUTCOMES: dict[Outcome, grid_pb2.Outcome.ValueType] = {
    Outcome.CORRECTED: grid_pb2.OUTCOME_CORRECTED,
    Outcome.LEFT_ALONE: grid_pb2.OUTCOME_LEFT_ALONE,
}
FRAME_STATUSES: dict[FrameStatus, correction_pb2.FrameStatus.ValueType] = {
    FrameStatus.CORRECTED: correction_pb2.FRAME_STATUS_CORRECTED,
    FrameStatus.PASSED_THROUGH: correction_pb2.FRAME_STATUS_PASSED_THROUGH,
    FrameStatus.DROPPED: correction_pb2.FRAME_STATUS_DROPPED,
    FrameStatus.FAILED: correction_pb2.FRAME_STATUS_FAILED,
}
#: Far more than the domain takes; so many are not even looked at.
_MOST_GUIDES = 256
_FORMAT_NAMES = ", ".join([*RAW_FORMATS.values(), *ENCODED_FORMATS.values()])


def to_format(number: int) -> PixelFormat | str:
    """The raw format, or the name of the encoded one. Raises UnsupportedPixelFormat."""
    if (raw := RAW_FORMATS.get(number)) is not None:
        return raw
    if (encoded := ENCODED_FORMATS.get(number)) is not None:
        return encoded
    said = "No pixel format was said." if number == 0 else f"Pixel format {number} is not known."
    raise UnsupportedPixelFormat(said, allowed=_FORMAT_NAMES)


def to_frame(pixel_format: PixelFormat, width: int, height: int, data: bytes) -> Frame:
    """A raw frame over the bytes of the message. Raises InvalidFrame."""
    return Frame(pixel_format, width, height, np.frombuffer(data, np.uint8))


def to_correct(number: int) -> Correct:
    """Raises InvalidOption."""
    if number not in CORRECTS:
        raise InvalidOption(f"correct={number} is not known.", allowed=", ".join(Correct))
    return CORRECTS[number]


def to_while_estimating(number: int) -> WhileEstimating:
    """Raises InvalidOption."""
    if number not in WHILE_ESTIMATING:
        raise InvalidOption(f"while_estimating={number} is not known.", allowed=", ".join(WhileEstimating))
    return WHILE_ESTIMATING[number]


def to_delivery(number: int) -> Delivery:
    """Raises InvalidOption."""
    if number not in DELIVERIES:
        raise InvalidOption(f"delivery={number} is not known.", allowed=", ".join(Delivery))
    return DELIVERIES[number]


def to_options(correct: int, rendering: frame_pb2.Rendering, min_confidence: float | None) -> CorrectOptions:
    """The options of a call or stream; what is absent has the defaults of the design. Raises InvalidOption."""
    if rendering.quality > 100:
        raise InvalidOption(f"quality={rendering.quality} is out of range.", allowed="1..100, or 0 for the default")
    return CorrectOptions(
        correct=to_correct(correct),
        fit=Fit.parse(rendering.fit or "crop"),
        strength=rendering.strength if rendering.HasField("strength") else 1.0,
        border=to_border(rendering.border) if rendering.HasField("border") else BLACK,
        quality=rendering.quality or None,
        min_confidence=min_confidence,
    )


def to_border(message: frame_pb2.Border) -> Border:
    """Raises InvalidOption."""
    samples = message.red, message.green, message.blue, message.alpha
    if max(samples) > 255:
        raise InvalidOption(f"border={samples} is out of range.", allowed="0..255")
    return Border(*samples)


def to_grid(message: grid_pb2.Grid) -> Grid:
    """Raises InvalidGrid."""
    if len(message.source) != 2 * message.rows * message.columns:
        raise InvalidGrid(
            f"{len(message.source)} numbers for {message.rows} rows and {message.columns} columns.",
            allowed="2 x rows x columns numbers",
        )
    source = np.array(message.source, dtype=np.float32)
    return Grid(source.reshape(message.rows, message.columns, 2))


def to_guides(message: grid_pb2.Guides) -> Guides:
    """Raises InvalidGuides."""
    if max(len(message.rows), len(message.columns)) > _MOST_GUIDES:
        raise InvalidGuides(f"{len(message.rows)} and {len(message.columns)} guides.", allowed="2 to 16 a direction")
    return Guides(_to_family(list(message.rows)), _to_family(list(message.columns)))


def from_grid(grid: Grid) -> grid_pb2.Grid:
    return grid_pb2.Grid(rows=grid.rows, columns=grid.columns, source=grid.source.ravel().tolist())


def from_guides(guides: Guides) -> grid_pb2.Guides:
    return grid_pb2.Guides(rows=_from_family(guides.rows), columns=_from_family(guides.columns))


def from_record(record: GridRecord, *, whole: bool) -> grid_pb2.GridRecord:
    """The message of a record; without lattice and guides unless it is to be ``whole``."""
    return grid_pb2.GridRecord(
        grid_id=record.id,
        grid=from_grid(record.grid) if whole else None,
        guides=from_guides(record.guides) if whole and record.guides is not None else None,
        confidence=record.confidence,
        confidence_kind=record.confidence_kind,
        outcome=OUTCOMES[record.outcome],
        reason=record.reason.value,
        strength=record.strength,
        model=record.model,
    )


def from_result(result: StreamResult) -> correction_pb2.StreamResult:
    """The message of a result, without its data."""
    message = correction_pb2.StreamResult(
        index=result.index, timestamp_us=result.timestamp_us, status=FRAME_STATUSES[result.status]
    )
    if result.error is not None:
        message.error.code = result.error.code
        message.error.message = str(result.error)
    if result.shared is not None:
        message.shared.region_id = result.shared.region_id
        message.shared.source_offset = result.shared.source_offset
        message.shared.target_offset = result.shared.target_offset
        message.shared.size_bytes = result.shared.size_bytes
    return message


def _to_family(guides: list[grid_pb2.Guide]) -> GuideFamily:
    if len({len(guide.coefficients) for guide in guides}) > 1:
        raise InvalidGuides("Guides of one direction need the same number of coefficients.")
    anchors = np.array([guide.anchor for guide in guides], dtype=np.float64)
    coefficients = np.array([list(guide.coefficients) for guide in guides], dtype=np.float64)
    return GuideFamily(anchors, coefficients)


def _from_family(family: GuideFamily) -> list[grid_pb2.Guide]:
    pairs = zip(family.anchors.tolist(), family.coefficients.tolist(), strict=True)
    return [grid_pb2.Guide(anchor=anchor, coefficients=coefficients) for anchor, coefficients in pairs]
