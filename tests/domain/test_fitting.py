from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.domain.lenses import BARREL, PINCUSHION, WAVE, affine, error_px, projective, radial, rotation, shear, wave
from unbend_service.domain.errors import InvalidGuides
from unbend_service.domain.fitting import fit_guides, guides_from_map
from unbend_service.domain.grid import Grid
from unbend_service.domain.guides import DEFAULT_ANCHORS, GuideFamily, Guides
from unbend_service.domain.maps import BackwardMap, target_lattice

#: Middles of five equal parts of the range of each family.
SHARES = (0.1, 0.3, 0.5, 0.7, 0.9)
FAMILIES: dict[str, Callable[[float], BackwardMap]] = {
    "barrel": lambda share: radial(share * BARREL),
    "pincushion": lambda share: radial(share * PINCUSHION),
    "projective": lambda share: projective(0.1 + 0.1 * share),
    "wave": lambda share: wave(share * WAVE),
}


@pytest.mark.parametrize(
    ("guides", "degree", "family", "floor_px"),
    [
        (2, 3, "barrel", 2.3),
        (2, 3, "pincushion", 3.4),
        (2, 3, "projective", 6.0),
        (2, 3, "wave", 1.2),
        (4, 3, "barrel", 0.15),
        (4, 3, "pincushion", 0.42),
        (4, 3, "projective", 0.07),
        (4, 3, "wave", 1.1),
        (4, 5, "barrel", 0.15),
        (4, 5, "pincushion", 0.42),
        (4, 5, "projective", 0.07),
        (4, 5, "wave", 0.07),
    ],
)
def test_guides_reach_the_known_floor(guides: int, degree: int, family: str, floor_px: float) -> None:
    """The mean error of the best guides over the range of a family is that of the design, px at 256.

    The known floors are means of random draws; a twentieth is left for the difference to even shares.
    """
    anchors = DEFAULT_ANCHORS if guides == 4 else (-0.8, 0.8)
    errors = []
    for share in SHARES:
        true = FAMILIES[family](share)
        errors.append(error_px(guides_from_map(true, anchors, degree, points=25), true).mean())
    assert np.mean(errors) <= 1.05 * floor_px
    if guides == 2 or (degree == 3 and family == "wave"):  # and the caps are real: nothing hides in the comparison
        assert np.mean(errors) > 0.5 * floor_px


@pytest.mark.parametrize("true", [rotation(-15), rotation(15), shear(0.4), shear(-0.4), radial(0.0)])
def test_plane_maps_without_perspective_are_exact(true: BackwardMap) -> None:
    """Rotations and shears over the whole range are recovered to a thousandth of a pixel."""
    assert error_px(guides_from_map(true, points=25), true).max() < 1e-3


@settings(max_examples=25)
@given(
    st.lists(st.floats(-0.3, 0.3), min_size=4, max_size=4),
    st.lists(st.floats(-0.2, 0.2), min_size=2, max_size=2),
)
def test_affine_maps_are_exact(entries: list[float], shift: list[float]) -> None:
    """Straight lines need no more than straight guides: any affine map is recovered to a thousandth of a pixel."""
    true = affine(np.eye(2) + np.array(entries).reshape(2, 2), np.array(shift))
    assert error_px(guides_from_map(true, points=15, polish=3), true, points=24).max() < 1e-3


@settings(max_examples=15)
@given(st.floats(BARREL, PINCUSHION), st.floats(-0.1, 0.1))
def test_radial_maps_are_recovered_wherever_their_centre(strength: float, centre: float) -> None:
    """Any division model of the range, also off centre, within 1.6 px on average, 0.3 px when half as strong."""
    true = radial(strength, centre)
    mean = error_px(guides_from_map(true, points=25, polish=0), true, points=32).mean()
    assert mean < (0.3 if abs(strength) < 0.15 else 1.6)


@pytest.mark.parametrize("true", [radial(BARREL), radial(0.8 * PINCUSHION), projective(0.2), wave(WAVE)])
def test_lattices_are_fine_enough(true: BackwardMap) -> None:
    """65x65 points are within 0.05 px of the continuous map on average, 33x33 within 0.1 px."""
    guides = guides_from_map(true, points=25)
    fine, coarse = (error_px(Grid.from_map(guides, n, n), true) for n in (65, 33))
    continuous = error_px(guides, true).mean()
    assert fine.mean() < continuous + 0.05
    assert coarse.mean() < continuous + 0.1


@pytest.mark.parametrize("true", [radial(BARREL), projective(0.2), wave(WAVE)])
def test_lattices_are_fine_everywhere(true: BackwardMap) -> None:
    """Where the source does not run away at the rim, 65x65 points are nowhere further off than 0.06 px."""
    guides = guides_from_map(true, points=25)
    assert error_px(Grid.from_map(guides, 65, 65), guides, points=201).max() < 0.06


def test_polishing_makes_nothing_worse() -> None:
    """The true distance at the correspondences never grows by polishing."""
    for true in (radial(BARREL), radial(PINCUSHION), projective(0.2), wave(WAVE)):
        target = target_lattice(25, 25).reshape(-1, 2)
        source = true(target)
        with np.errstate(invalid="ignore"):
            visible = (np.abs(source) <= 1).all(axis=-1)
        source, target = source[visible], target[visible]
        rough, fine = (((fit_guides(source, target, polish=n)(target) - source) ** 2).sum() for n in (0, 4))
        assert fine <= rough


def test_guides_are_found_again_from_their_own_map() -> None:
    """Fitting to the map of known guides gives that map back to a hundredth of a pixel."""
    anchors = np.array(DEFAULT_ANCHORS)
    rng = np.random.default_rng(7)
    straight = GuideFamily.straight(anchors, 3).coefficients
    rows, columns = (GuideFamily(anchors, straight + rng.normal(0, 0.03, straight.shape)) for _ in range(2))
    true = Guides(rows, columns)
    assert error_px(guides_from_map(true, degree=3, polish=6), true).max() < 0.01


def test_weights_say_what_counts() -> None:
    """A wild correspondence of weight 0 is not heard, and one of weight 1 is."""
    target = target_lattice(9, 9).reshape(-1, 2)
    source = radial(-0.1)(target)
    wild, weights = source.copy(), np.ones(len(source))
    wild[40] += 0.5
    weights[40] = 0
    expected = fit_guides(np.delete(source, 40, 0), np.delete(target, 40, 0), polish=0)
    deaf = fit_guides(wild, target, weights=weights, polish=0)
    np.testing.assert_allclose(deaf.rows.coefficients, expected.rows.coefficients, atol=1e-6)
    hearing = fit_guides(wild, target, polish=0)
    assert np.abs(hearing.rows.coefficients - expected.rows.coefficients).max() > 1e-3


def test_what_is_not_seen_stays_straight() -> None:
    """A single correspondence moves the guides no more than it must: the rest stays near the identity."""
    guides = fit_guides([[0.02, 0.0]], [[0.0, 0.0]])
    np.testing.assert_allclose(guides(np.zeros(2)), [0.02, 0.0], atol=1e-4)
    assert error_px(guides, radial(0.0)).max() < 0.1 / (2 / 256)


@pytest.mark.parametrize(
    ("source", "target", "weights"),
    [
        ([[0, 0]], [[0, 0], [1, 1]], None),
        ([0, 0], [0, 0], None),
        ([[0, 0, 0]], [[0, 0, 0]], None),
        ([[np.nan, 0]], [[0, 0]], None),
        ([[0, 0]], [[np.inf, 0]], None),
        ([[0, 0]], [[0, 0]], [-1]),
        ([[0, 0]], [[0, 0]], [0]),
        ([[0, 0]], [[0, 0]], [1, 1]),
        ([[0, 0]], [[0, 0]], [np.nan]),
        (np.zeros((0, 2)), np.zeros((0, 2)), None),
    ],
)
def test_useless_correspondences_are_refused(source: object, target: object, weights: object) -> None:
    """Arrays that do not match or are not numbers raise InvalidGuides, not a numpy error."""
    with pytest.raises(InvalidGuides):
        fit_guides(source, target, weights=weights)  # type: ignore[arg-type]  # that they are wrong is the test


def test_a_map_that_shows_nothing_is_refused() -> None:
    """Guides cannot follow a map all of whose sources lie outside the picture."""
    with pytest.raises(InvalidGuides, match="nothing"):
        guides_from_map(lambda target: target + 5)
