"""What is remembered of a camera."""

from __future__ import annotations

import pytest

from tests.fakes import barrel_guides
from unbend_service.domain.aggregation import Look
from unbend_service.domain.camera_record import MOST_LOOKS, CameraRecord, check_camera_name
from unbend_service.domain.errors import InvalidGrid, InvalidOption


def look(bend: float = 0.06, error: float = 0.02) -> Look:
    return Look(barrel_guides(bend), 0.7, error)


def record(error: float = 0.02) -> CameraRecord:
    return CameraRecord.first("lineset", "calibrated_probability", 1.5, look(error=error), "p0")


def test_a_picture_counts_once() -> None:
    one = record()

    assert one.with_look(look(), "p0") is one
    assert one.with_look(look(), "p1").version == 2


def test_pictures_that_agree_lower_the_expected_error() -> None:
    one = record()
    two = one.with_look(look(0.061), "p1").with_look(look(0.059), "p2")

    assert two.fused.expected_error < one.fused.expected_error
    assert two.fused.agreeing == 3


def test_it_locks_when_the_lens_is_known_well_enough() -> None:
    seen = record(error=0.002)
    for number in range(1, 5):
        assert not seen.is_locked
        seen = seen.with_look(look(error=0.002), f"p{number}")

    assert seen.is_locked
    assert seen.with_look(look(0.3), "late") is seen


def test_it_locks_after_as_many_pictures_as_it_keeps() -> None:
    seen = record()
    for number in range(1, MOST_LOOKS):
        seen = seen.with_look(look(0.06 + 0.01 * (number % 3)), f"p{number}")

    assert seen.is_locked
    assert len(seen.looks) == MOST_LOOKS


def test_it_comes_back_from_bytes_as_it_was() -> None:
    seen = record().with_look(look(0.05), "p1")

    back = CameraRecord.from_bytes(seen.to_bytes())

    assert back.to_bytes() == seen.to_bytes()
    assert (back.version, back.pictures, back.aspect) == (2, ("p0", "p1"), 1.5)


@pytest.mark.parametrize("value", [b"", b"{}", b"[1]", b'{"model": 3}'])
def test_damaged_bytes_are_refused(value: bytes) -> None:
    with pytest.raises(InvalidGrid, match="damaged"):
        CameraRecord.from_bytes(value)


def test_pictures_of_other_proportions_are_refused() -> None:
    record().check_aspect(1.505)
    with pytest.raises(InvalidOption, match="aspect"):
        record().check_aspect(2 / 3)


@pytest.mark.parametrize("name", ["", " a", "a b", "-a", "x" * 129, "caméra"])
def test_what_cannot_name_a_camera_is_refused(name: str) -> None:
    with pytest.raises(InvalidOption, match="camera"):
        check_camera_name(name)
