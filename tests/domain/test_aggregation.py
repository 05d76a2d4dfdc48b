"""What several frames say together."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unbend_service.domain.aggregation import Look, fuse, weighted_median
from unbend_service.domain.errors import InvalidGuides
from unbend_service.domain.fitting import guides_from_map
from unbend_service.domain.guides import Float64, GuideFamily, Guides
from unbend_service.domain.homography import apply_homography, without_plane_part
from unbend_service.domain.maps import target_lattice

ANCHORS = np.array([-0.9, -0.3, 0.3, 0.9])


def bent(bend: float) -> Guides:
    coefficients = np.zeros((4, 6))
    coefficients[:, 0] = ANCHORS * (1 + bend / 2)
    coefficients[:, 2] = -ANCHORS * bend
    family = GuideFamily(ANCHORS, coefficients)
    return Guides(family, family)


def lens_of(guides: Guides) -> Float64:
    """The map without its plane part."""
    return without_plane_part(guides)(target_lattice(17, 17, 0.9))


def distance(one: Float64, other: Float64) -> float:
    return float(np.hypot(*(one - other).reshape(-1, 2).T).mean())


def looks(guides: list[Guides], error: float = 0.005, confidence: float = 0.9) -> list[Look]:
    return [Look(one, confidence, error) for one in guides]


def apart(one: Guides, other: Guides) -> float:
    target = target_lattice(17, 17, 0.9)
    return float(np.abs(one(target) - other(target)).max())


def test_looks_that_are_far_off_do_not_move_the_grid() -> None:
    good = [bent(0.06), bent(0.062), bent(0.058), bent(0.061), bent(0.059)]

    fused = fuse(looks([good[0], bent(-0.3), *good[1:], bent(0.35)]))

    assert fused.agreeing == 5
    assert apart(fused.guides, bent(0.06)) < 0.002


def test_a_look_counts_by_the_error_it_expects() -> None:
    sure, unsure = Look(bent(0.10), 0.9, 0.002), Look(bent(0.08), 0.9, 0.02)

    fused = fuse([unsure, sure])

    assert apart(fused.guides, bent(0.10)) < 0.001
    assert fused.expected_error < 0.003


def test_noise_averages_out() -> None:
    """Ten looks with independent errors are at least twice as near to the lens as one."""
    rng = np.random.default_rng(3)
    true = bent(0.08)

    def noisy() -> Guides:
        families = [
            GuideFamily(ANCHORS, family.coefficients + rng.normal(0, 0.01, (4, 6)) * (np.arange(6) > 1))
            for family in (true.rows, true.columns)
        ]
        return Guides(*families)

    seen = [noisy() for _ in range(10)]
    truth = lens_of(true)

    single = np.mean([distance(lens_of(one), truth) for one in seen])
    together = distance(lens_of(fuse(looks(seen)).guides), truth)

    assert together < single / 2


def test_pictures_taken_askew_still_agree_on_the_lens() -> None:
    """Each is seen with another tilt; what they have in common is found whatever the pose."""
    true = bent(0.08)
    rng = np.random.default_rng(5)
    seen = []
    for _ in range(5):
        tilt = np.eye(3) + rng.normal(0, 0.04, (3, 3)) * [[1, 1, 0], [1, 1, 0], [1, 1, 0]]
        seen.append(guides_from_map(lambda points, tilt=tilt: true(apply_homography(tilt, points)), ANCHORS))

    fused = fuse(looks(seen))

    assert fused.agreeing == 5
    assert distance(lens_of(fused.guides), lens_of(true)) < 0.004


def test_guides_of_different_number_and_degree_are_combined() -> None:
    finer = guides_from_map(bent(0.06), np.linspace(-0.9, 0.9, 8))

    fused = fuse(looks([bent(0.06), finer]))

    assert len(fused.guides.rows.anchors) == 8
    assert apart(fused.guides, bent(0.06)) < 0.001


def test_one_look_comes_back_as_it_is() -> None:
    only = bent(0.05)

    fused = fuse([Look(only, 0.4, 0.01)])

    assert fused.guides is only
    assert (fused.confidence, fused.expected_error) == (0.4, 0.01)


def test_agreement_adds_confidence_and_a_blind_frame_takes_none() -> None:
    sure = looks([bent(0.06)] * 4, confidence=0.8)
    blind = Look(Guides.straight(), 0.0, None)

    assert fuse(sure).confidence > 0.85
    assert fuse([*sure, blind]).confidence > 0.8


def test_without_any_guides_there_is_nothing_to_combine() -> None:
    with pytest.raises(InvalidGuides, match="no guides"):
        fuse([])


@given(
    st.lists(st.floats(-2, 2, allow_nan=False), min_size=1, max_size=12),
    st.randoms(use_true_random=False),
)
def test_the_median_does_not_depend_on_the_order_and_lies_within_the_values(values, random) -> None:
    pairs = [(value, random.choice([0.25, 0.5, 1.0])) for value in values]
    shuffled = pairs.copy()
    random.shuffle(shuffled)

    one, other = (
        float(weighted_median(np.array([v for v, _ in p])[:, None], np.array([w for _, w in p]))[0])
        for p in (pairs, shuffled)
    )

    assert one == pytest.approx(other)
    assert min(values) <= one <= max(values)


@given(st.lists(st.floats(-2, 2, allow_nan=False), min_size=1, max_size=12))
def test_with_equal_weights_it_is_the_ordinary_median(values) -> None:
    assert weighted_median(np.array(values)[:, None], np.ones(len(values)))[0] == pytest.approx(np.median(values))
