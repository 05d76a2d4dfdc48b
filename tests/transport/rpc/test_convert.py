"""Messages and what they mean."""

from __future__ import annotations

import numpy as np
import pytest

from tests.fakes import barrel_guides
from unbend.v1 import correction_pb2, frame_pb2, grid_pb2
from unbend_service.application.stream_messages import Delivery, FrameStatus, WhileEstimating
from unbend_service.domain.errors import InvalidGrid, InvalidGuides, InvalidOption, UnsupportedPixelFormat
from unbend_service.domain.frames import PixelFormat
from unbend_service.domain.grid import Grid
from unbend_service.domain.records import Correct, Outcome
from unbend_service.transport.rpc import convert


@pytest.mark.parametrize(
    ("table", "numbers"),
    [
        ({**convert.RAW_FORMATS, **convert.ENCODED_FORMATS, 0: None}, frame_pb2.PixelFormat.values()),
        (convert.CORRECTS, grid_pb2.Correct.values()),
        (convert.WHILE_ESTIMATING, correction_pb2.WhileEstimating.values()),
        (convert.DELIVERIES, correction_pb2.Delivery.values()),
    ],
)
def test_every_number_of_the_wire_has_a_meaning(table: dict[int, object], numbers: list[int]) -> None:
    assert set(table) == set(numbers)


@pytest.mark.parametrize(
    ("values", "meant"),
    [
        (convert.RAW_FORMATS.values(), set(PixelFormat) - {PixelFormat.YUVJ420P}),
        (convert.CORRECTS.values(), Correct),
        (convert.WHILE_ESTIMATING.values(), WhileEstimating),
        (convert.DELIVERIES.values(), Delivery),
        (convert.OUTCOMES, Outcome),
        (convert.FRAME_STATUSES, FrameStatus),
    ],
)
def test_everything_that_can_be_meant_can_be_said(values: object, meant: object) -> None:
    assert set(values) == set(meant)


def test_a_grid_survives_the_wire_to_the_last_bit() -> None:
    grid = Grid.from_map(barrel_guides(), 9, 17)

    assert convert.to_grid(convert.from_grid(grid)).id == grid.id


def test_guides_survive_the_wire_to_the_last_bit() -> None:
    guides = barrel_guides()
    back = convert.to_guides(convert.from_guides(guides))

    assert np.array_equal(back.rows.coefficients, guides.rows.coefficients)
    assert np.array_equal(back.columns.anchors, guides.columns.anchors)


@pytest.mark.parametrize(
    "message",
    [
        grid_pb2.Grid(),
        grid_pb2.Grid(rows=2, columns=2, source=[0.0] * 7),
        grid_pb2.Grid(rows=2**31, columns=2**31, source=[]),
        grid_pb2.Grid(rows=2, columns=2, source=[float("nan")] * 8),
    ],
)
def test_a_lattice_of_the_wrong_shape_or_with_nan_is_refused(message: grid_pb2.Grid) -> None:
    with pytest.raises(InvalidGrid):
        convert.to_grid(message)


@pytest.mark.parametrize(
    "coefficients",
    [[], [[0.0, 0.0]], [[0.0, 0.0], [0.0]], [[float("inf"), 0.0], [0.0, 0.0]], [[], []]],
)
def test_guides_of_the_wrong_shape_are_refused(coefficients: list[list[float]]) -> None:
    guides = [grid_pb2.Guide(anchor=i / 4, coefficients=c) for i, c in enumerate(coefficients)]
    with pytest.raises(InvalidGuides):
        convert.to_guides(grid_pb2.Guides(rows=guides, columns=guides))


@pytest.mark.parametrize("number", [0, 99])
def test_a_pixel_format_that_is_not_said_or_not_known_is_refused(number: int) -> None:
    with pytest.raises(UnsupportedPixelFormat, match="gray8"):
        convert.to_format(number)


def test_options_out_of_range_are_refused() -> None:
    for rendering in (
        frame_pb2.Rendering(quality=101),
        frame_pb2.Rendering(border=frame_pb2.Border(red=256)),
        frame_pb2.Rendering(fit="sideways"),
    ):
        with pytest.raises(InvalidOption):
            convert.to_options(0, rendering, None)
    for convert_number in (convert.to_correct, convert.to_delivery, convert.to_while_estimating):
        with pytest.raises(InvalidOption):
            convert_number(99)


def test_absent_options_have_the_defaults_of_the_design() -> None:
    options = convert.to_options(0, frame_pb2.Rendering(), None)

    assert (str(options.fit), options.strength, options.correct) == ("crop", 1.0, Correct.NONLINEAR)
    assert (options.quality, options.border.alpha) == (None, 255)
