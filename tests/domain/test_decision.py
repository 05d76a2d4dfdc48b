"""How far an estimate is followed."""

from __future__ import annotations

import pytest

from tests.fakes import barrel_guides
from unbend_service.domain.decision import Caution, decide
from unbend_service.domain.records import Correct, GridRecord, Outcome, Reason

PIXEL = 2 / 256
CAREFUL = Caution(min_confidence=0.3, full_confidence=0.6, doubtful_displacement=0.5 * PIXEL)


def decided(confidence: float, caution: Caution = CAREFUL, bend: float = 0.1) -> GridRecord:
    return decide(barrel_guides(bend), confidence, "", "", correct=Correct.NONLINEAR, caution=caution)


def test_what_is_hardly_believed_changes_nothing() -> None:
    record = decided(0.29)
    assert (record.outcome, record.reason, record.strength) == (Outcome.LEFT_ALONE, Reason.LOW_CONFIDENCE, 0.0)


def test_what_is_doubtful_moves_the_picture_by_so_much_and_no_more() -> None:
    """Half a pixel, whatever the size of the estimate; and the strength says what share that is."""
    mild, strong, whole = decided(0.3, bend=0.05), decided(0.59), decided(0.6)
    assert (whole.outcome, whole.reason, whole.strength) == (Outcome.CORRECTED, Reason.NONE, 1.0)
    for record in (mild, strong):
        assert (record.outcome, record.reason) == (Outcome.CORRECTED, Reason.LOW_CONFIDENCE)
        assert record.grid.displacement == pytest.approx(0.5 * PIXEL, rel=1e-3)
    assert strong.strength == pytest.approx(0.5 * PIXEL / whole.grid.displacement)
    assert strong.strength < mild.strength < 1


def test_a_doubtful_estimate_of_less_than_that_is_followed_all_the_way() -> None:
    record = decided(0.4, Caution(0.3, 0.6, 100 * PIXEL))
    assert (record.reason, record.strength) == (Reason.NONE, 1.0)


def test_a_threshold_alone_knows_no_doubt() -> None:
    """As a request or the setting asks for it: nothing below, everything from there on."""
    assert decided(0.49, Caution(0.5, 0.5)).strength == 0
    assert decided(0.5, Caution(0.5, 0.5)).strength == 1
    assert decided(0.0, Caution()).strength == 1
