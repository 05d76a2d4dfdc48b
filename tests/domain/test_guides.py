from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tests.domain.lenses import BARREL, PINCUSHION, error_px, radial, rotation
from unbend_service.domain.decision import spin_grid
from unbend_service.domain.errors import InvalidGuides
from unbend_service.domain.fitting import fit_guides, guides_from_map
from unbend_service.domain.grid import Grid
from unbend_service.domain.guides import DEFAULT_ANCHORS, MAX_REACH, TRUSTED_EXTENT, GuideFamily, Guides
from unbend_service.domain.maps import Float64, target_lattice
from unbend_service.domain.records import Correct

ANCHORS = np.array(DEFAULT_ANCHORS)


def bent(rows: Float64, columns: Float64, anchors: Float64 = ANCHORS) -> Guides:
    """Guides whose coefficients deviate from straight ones by these (K, degree + 1)."""
    straight = GuideFamily.straight(anchors, rows.shape[1] - 1).coefficients
    return Guides(GuideFamily(anchors, straight + rows), GuideFamily(anchors, straight + columns))


def deviations(degree: int = 3, size: float = 0.05) -> st.SearchStrategy[Float64]:
    return arrays(np.float64, (4, degree + 1), elements=st.floats(-size, size))


@given(
    st.lists(st.floats(-0.98, 0.98), min_size=2, max_size=16).filter(
        lambda values: np.diff(sorted(values)).min() >= 1e-3
    ),
    st.integers(1, 15),
    st.integers(2, 40),
)
def test_straight_guides_change_nothing(anchors: list[float], degree: int, points: int) -> None:
    """Whatever their number, anchors and degree, undistorted guides give the identity grid."""
    guides = Guides.straight(sorted(anchors), degree)
    assert guides.is_straight
    grid = Grid.from_map(guides, points, points + 1)
    np.testing.assert_allclose(grid.source, target_lattice(points, points + 1), atol=1e-6)
    assert grid.id == Grid.identity(points, points + 1).id


@given(deviations(), deviations(), st.floats(-1, 1), st.floats(-1, 1))
def test_sources_lie_on_both_curves(rows: Float64, columns: Float64, s: float, t: float) -> None:
    """The source of (s, t) is where the row curve of t and the column curve of s intersect."""
    guides = bent(rows, columns)
    x, y = guides(np.array([s, t]))
    row, column = guides.rows.at(np.array([t]))[0], guides.columns.at(np.array([s]))[0]
    assert y == pytest.approx(np.polynomial.polynomial.polyval(x, row), abs=1e-6)
    assert x == pytest.approx(np.polynomial.polynomial.polyval(y, column), abs=1e-6)


@given(deviations(size=0.1), deviations(size=0.1))
def test_a_guide_is_the_source_of_a_straight_line(rows: Float64, columns: Float64) -> None:
    """Along its anchor the map runs on the very guide: that is what becomes straight."""
    guides = bent(rows, columns)
    for anchor, row in zip(guides.rows.anchors, guides.rows.coefficients, strict=True):
        target = np.stack([np.linspace(-0.9, 0.9, 7), np.full(7, anchor)], axis=-1)
        source = guides(target)
        source = source[np.abs(source[:, 0]) <= TRUSTED_EXTENT]
        np.testing.assert_allclose(source[:, 1], np.polynomial.polynomial.polyval(source[:, 0], row), atol=1e-6)


@given(deviations(5, 0.3), deviations(5, 0.3))
def test_any_guides_give_finite_points_or_a_typed_error(rows: Float64, columns: Float64) -> None:
    """Also guides that cross, turn back or never meet: numbers within reach, or InvalidGuides."""
    try:
        source = bent(rows, columns)(target_lattice(17, 17, 2.0))
    except InvalidGuides:
        return
    assert np.isfinite(source).all()
    assert np.abs(source).max() <= MAX_REACH * (1 + 1e-12)


def test_the_other_side_of_a_fold_is_not_shown() -> None:
    """Where two guides cross twice only the first crossing counts: in sight the curves cross, they never touch."""
    shown = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        guides = bent(*rng.normal(0, 0.3, (2, 4, 4)))
        lattice = target_lattice(33, 33).reshape(-1, 2)
        try:
            source = guides(lattice)
        except InvalidGuides:
            continue
        visible = (np.abs(source) <= 1).all(axis=1)
        slopes = []
        for family, across, along in ((guides.rows, 1, 0), (guides.columns, 0, 1)):
            curves = family.at(lattice[visible, across])
            powers = np.vander(source[visible, along], 3, increasing=True)
            slopes.append((curves[:, 1:] * [1, 2, 3] * powers).sum(axis=1))
        assert (1 - slopes[0] * slopes[1] > 0).all()
        shown += int(visible.sum())
    assert shown > 1000


def test_guides_that_never_meet_are_refused() -> None:
    """Rows and columns that run side by side are no grid."""
    rows = np.zeros((4, 4))
    rows[:, 1] = 1.0
    with pytest.raises(InvalidGuides, match="intersect"):
        Grid.from_map(bent(rows, rows))


@pytest.mark.parametrize("degree", [3, 5])
@pytest.mark.parametrize("strength", np.linspace(BARREL, PINCUSHION, 9).tolist())
def test_the_whole_radial_range_gives_unfolded_grids(strength: float, degree: int) -> None:
    """Up to pincushions in whose corners no source is left, guides give a grid, and nothing comes back into sight."""
    true = radial(strength)
    grid = Grid.from_map(guides_from_map(true, degree=degree, points=25, polish=0))
    grid.check_unfolded()
    target = target_lattice(65, 65)
    with np.errstate(invalid="ignore"):
        outside = ~(np.abs(true(target)) <= 1.1).all(axis=-1)
    assert (np.abs(grid.source).max(axis=-1)[outside] > 1).all()


@pytest.mark.parametrize("points", [33, 65])
@pytest.mark.parametrize("centre", [(0.0, 0.0), (-0.02, 0.03), (0.02, 0.0)])
@pytest.mark.parametrize("division", [0.31, 0.33, 0.35])
def test_hard_pincushions_about_any_centre_do_not_fold(
    division: float, centre: tuple[float, float], points: int
) -> None:
    """Where the lens itself folds in the corners of the target, the cells beside the last source point keep their
    orientation, as those of an estimate's eight guides would otherwise have the whole picture left alone."""
    source = target_lattice(61, 61).reshape(-1, 2)
    away = source - centre
    target = away / (1 + division * (away**2).sum(axis=1, keepdims=True)) + centre
    guides = fit_guides(source, target, np.linspace(-0.9, 0.9, 8), 5)
    assert spin_grid(guides, Correct.NONLINEAR, points).is_unfolded


def test_strong_rotations_are_spun() -> None:
    """Guides turned by 40 degrees still intersect where they should."""
    true = rotation(40)
    assert error_px(guides_from_map(true, points=25, polish=0), true).max() < 0.05


@given(deviations(), deviations())
def test_one_point_or_many_is_the_same(rows: Float64, columns: Float64) -> None:
    """The shape of the targets is kept, and no point depends on its neighbours."""
    guides, lattice = bent(rows, columns), target_lattice(5, 7)
    source = guides(lattice)
    assert source.shape == (5, 7, 2)
    np.testing.assert_allclose(guides(lattice[2, 3]), source[2, 3], atol=1e-6)
    assert guides(np.zeros((0, 2))).shape == (0, 2)


@given(deviations(5, 1.0), deviations(5, 1.0))
def test_json_round_trip_is_exact(rows: Float64, columns: Float64) -> None:
    """Guides come back from JSON to the last bit."""
    guides = bent(rows, columns)
    again = Guides.from_dict(json.loads(json.dumps(guides.to_dict())))
    for one, other in ((guides.rows, again.rows), (guides.columns, again.columns)):
        assert one.anchors.tobytes() == other.anchors.tobytes()
        assert one.coefficients.tobytes() == other.coefficients.tobytes()


def one_guide(**changes: object) -> dict[str, object]:
    return {"anchor": 0.5, "coefficients": [0.5, 0.0]} | changes


@pytest.mark.parametrize(
    "rows",
    [
        None,
        5,
        "rows",
        [],
        [one_guide()],
        [one_guide(), one_guide()],
        [one_guide(), one_guide(anchor=-0.5)],
        [one_guide(anchor=-0.5), one_guide(anchor=1.0)],
        [one_guide(anchor=-0.5), one_guide(anchor=float("nan"))],
        [one_guide(anchor=-0.5), one_guide(coefficients=[float("inf"), 0.0])],
        [one_guide(anchor=-0.5), one_guide(coefficients=[17.0, 0.0])],
        [one_guide(anchor=-0.5), one_guide(coefficients=[10**400, 0.0])],
        [one_guide(anchor=-0.5), one_guide(coefficients=[0.5])],
        [one_guide(anchor=-0.5), one_guide(coefficients="0.5")],
        [one_guide(anchor=-0.5), one_guide(coefficients=None)],
        [one_guide(anchor=-0.5, coefficients=[0.5] * 17), one_guide(coefficients=[0.5] * 17)],
        [one_guide(anchor=-0.5, coefficients=[]), one_guide(coefficients=[])],
        [one_guide(anchor=-0.9 + 0.1 * i) for i in range(17)],
        [{"anchor": 0.0}, one_guide()],
    ],
)
def test_broken_guides_are_refused(rows: object) -> None:
    """Whatever JSON can hold, from_dict raises InvalidGuides or gives guides."""
    good = Guides.straight().to_dict()
    with pytest.raises(InvalidGuides):
        Guides.from_dict(good | {"rows": rows})
    with pytest.raises(InvalidGuides):
        Guides.from_dict(good | {"columns": rows})
    with pytest.raises(InvalidGuides):
        Guides.from_dict([rows])


def test_guides_cannot_be_changed() -> None:
    """Arrays inside are copies and read-only, so that a grid's provenance stays true."""
    anchors = np.array(DEFAULT_ANCHORS)
    family = GuideFamily.straight(anchors)
    anchors[0] = 0
    assert family.anchors[0] == -0.9
    with pytest.raises(ValueError, match="read-only"):
        family.coefficients[0, 0] = 1
