from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.domain.lenses import radial
from unbend_service.domain.errors import InvalidGrid, InvalidGuides, InvalidOption
from unbend_service.domain.fitting import guides_from_map
from unbend_service.domain.grid import Grid
from unbend_service.domain.records import Correct, GridRecord, Outcome, Reason

GUIDES = guides_from_map(radial(-0.1), points=9, polish=0)
GRID = Grid.from_map(GUIDES, 5, 5)


@settings(max_examples=20)
@given(
    st.sampled_from([None, GUIDES]),
    st.floats(0, 1),
    st.text(max_size=8),
    st.sampled_from(Outcome),
    st.sampled_from(Reason),
    st.floats(0, 1),
    st.text(max_size=8),
)
def test_records_survive_json(
    guides: object, confidence: float, kind: str, outcome: Outcome, reason: Reason, strength: float, model: str
) -> None:
    """Whatever was decided of an estimate comes back from JSON exactly, and under the same id."""
    record = GridRecord(GRID, guides, confidence, kind, outcome, reason, strength, model)
    again = GridRecord.from_dict(json.loads(json.dumps(record.to_dict())))
    assert again.to_dict() == record.to_dict()
    assert again.id == record.id == GRID.id
    assert again.grid.source.tobytes() == GRID.source.tobytes()


def test_only_the_grid_is_needed() -> None:
    """A bare grid, made by hand, is a record that is sure of itself."""
    record = GridRecord.from_dict({"grid": GRID.to_dict()})
    assert (record.confidence, record.strength, record.guides, record.outcome) == (1.0, 1.0, None, Outcome.CORRECTED)


def test_the_id_is_of_the_grid_alone() -> None:
    """Provenance does not change what a grid does, nor its id."""
    assert GridRecord(GRID, confidence=0.2, model="a").id == GridRecord(GRID, GUIDES, strength=0.5).id


@pytest.mark.parametrize(
    "change",
    [
        {"grid": None},
        {"confidence": "high"},
        {"confidence": None},
        {"confidence": float("nan")},
        {"confidence": 1.5},
        {"confidence": -0.1},
        {"strength": float("inf")},
        {"strength": []},
        {"outcome": "improved"},
        {"reason": 7},
    ],
)
def test_broken_records_are_refused(change: dict[str, object]) -> None:
    """Whatever JSON can hold, from_dict raises InvalidGrid or gives a record."""
    with pytest.raises(InvalidGrid):
        GridRecord.from_dict(GridRecord(GRID).to_dict() | change)


@pytest.mark.parametrize("value", [None, [], 5, {}, {"guides": GUIDES.to_dict()}])
def test_a_record_without_a_grid_is_refused(value: object) -> None:
    """There is no record of nothing."""
    with pytest.raises(InvalidGrid):
        GridRecord.from_dict(value)


def test_broken_guides_are_named_as_such() -> None:
    """Guides that are none are InvalidGuides, also inside a record."""
    with pytest.raises(InvalidGuides):
        GridRecord.from_dict({"grid": GRID.to_dict(), "guides": {"rows": []}})


def test_what_is_corrected_is_one_of_two() -> None:
    """nonlinear and all are read; anything else is answered with the two."""
    assert [Correct.parse(name) for name in ("nonlinear", "all")] == [Correct.NONLINEAR, Correct.ALL]
    with pytest.raises(InvalidOption, match="nonlinear, all"):
        Correct.parse("everything")


def test_what_is_sent_is_plain() -> None:
    """The dictionary holds nothing but what JSON knows: no numpy number, no enum."""
    record = GridRecord(GRID, GUIDES, float(np.float64(0.5)), reason=Reason.FOLDED).to_dict()
    assert type(record["outcome"]) is str
    assert type(record["grid"]["source"][0][0]) is float
    assert json.loads(json.dumps(record)) == record
