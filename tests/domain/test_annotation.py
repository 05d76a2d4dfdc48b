from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unbend_service.domain.annotation import Annotation, Curve
from unbend_service.domain.errors import InvalidGuides

COEFFICIENT = st.floats(-0.3, 0.3)


def value(points: int = 6, **changes: Any) -> dict[str, Any]:
    along = np.linspace(-0.8, 0.9, points)
    rows = [{"points": np.stack([along, at + 0.1 * along**2], 1).tolist()} for at in (-0.5, 0.5)]
    columns = [{"points": np.stack([at - 0.1 * along**2, along], 1).tolist()} for at in (-0.4, 0.6)]
    return {
        "version": 1, "image": "a.jpg", "width": 640, "height": 480, "rows": rows, "columns": columns, **changes
    }  # fmt: skip


@given(st.tuples(COEFFICIENT, COEFFICIENT, COEFFICIENT, COEFFICIENT), st.booleans())
def test_points_on_a_cubic_give_its_coefficients(coefficients: tuple[float, ...], upright: bool) -> None:
    """What was laid along a feature is what is learnt."""
    along = np.linspace(-0.9, 0.8, 7)
    points = np.stack([along, np.polynomial.polynomial.polyval(along, coefficients)], axis=1)
    curve = Curve(points[:, ::-1] if upright else points, upright)
    assert curve.is_complete
    assert np.abs(curve.coefficients - coefficients).max() < 1e-9


def test_the_json_comes_back_as_it_was_with_coefficients_of_its_own() -> None:
    """Coefficients in a file are for people and other programs; nobody can disagree with the points."""
    broken = value()
    broken["rows"][0]["coefficients"] = [9, 9, 9, 9]
    annotation = Annotation.from_dict(broken)
    again = json.loads(json.dumps(annotation.to_dict()))
    assert Annotation.from_dict(again).to_dict() == again
    assert again["rows"][0]["coefficients"] == pytest.approx([-0.5, 0, 0.1, 0], abs=1e-9)


def test_guides_lie_in_order_whatever_the_order_of_the_curves() -> None:
    """A person who takes the lower row for the upper one loses nothing."""
    annotation = Annotation.from_dict(value(rows=value()["rows"][::-1]))
    guides = annotation.guides()
    assert guides.rows.coefficients[:, 0] == pytest.approx([-0.5, 0.5])
    assert guides.rows.anchors == pytest.approx([-0.5 + 0.0243, 0.5 + 0.0243], abs=1e-3)
    assert guides.columns.degree == 3


def test_an_unfinished_annotation_is_kept_but_gives_no_guides() -> None:
    """Three points make no cubic; neither do four on one spot."""
    few = Annotation.from_dict(value(points=3))
    assert not few.is_complete
    assert few.rows[0].coefficients == pytest.approx([-0.5, 0, 0.1, 0], abs=1e-9)
    same = Curve(np.full((4, 2), 0.5), False)
    assert not same.is_complete
    assert same.coefficients == pytest.approx([0.5, 0, 0, 0])
    assert Curve(np.empty((0, 2)), True).coefficients.tolist() == [0, 0, 0, 0]
    with pytest.raises(InvalidGuides, match="not complete"):
        few.guides()


@pytest.mark.parametrize(
    "changes",
    [
        {"version": 2},
        {"image": 3},
        {"width": 0},
        {"width": True},
        {"height": 1.5},
        {"rows": []},
        {"rows": [{"points": []}]},
        {"columns": [{"points": [[1]]}, {"points": []}]},
        {"columns": [{"points": [["a", 1]]}, {"points": []}]},
        {"columns": [{"points": [[float("nan"), 0]]}, {"points": []}]},
        {"columns": [{"points": [[0, 2]]}, {"points": []}]},
        {"columns": [{"points": [[0, 0]] * 257}, {"points": []}]},
        {"columns": [{}, {"points": []}]},
        {"columns": "no"},
    ],
)
def test_anything_else_is_refused(changes: dict[str, Any]) -> None:
    """A file of another program is told from an annotation."""
    with pytest.raises(InvalidGuides):
        Annotation.from_dict(value(**changes))
    with pytest.raises(InvalidGuides):
        Annotation.from_dict([])
