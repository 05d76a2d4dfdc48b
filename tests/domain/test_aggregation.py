"""What several frames say together."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unbend_service.domain.aggregation import aggregate_guides, weighted_median
from unbend_service.domain.errors import InvalidGuides
from unbend_service.domain.guides import GuideFamily, Guides
from unbend_service.domain.maps import target_lattice

ANCHORS = np.array([-0.9, -0.3, 0.3, 0.9])


def bent(bend: float) -> Guides:
    coefficients = np.zeros((4, 6))
    coefficients[:, 0] = ANCHORS * (1 + bend / 2)
    coefficients[:, 2] = -ANCHORS * bend
    family = GuideFamily(ANCHORS, coefficients)
    return Guides(family, family)


def bend_of(guides: Guides) -> float:
    return float(-guides.rows.coefficients[0, 2] / guides.rows.anchors[0])


def test_frames_that_are_far_off_do_not_move_the_grid() -> None:
    good = [bent(0.06), bent(0.062), bent(0.058), bent(0.061), bent(0.059)]
    wild = np.random.default_rng(1).uniform(-0.3, 0.3, (4, 6))
    outlier = Guides(GuideFamily(ANCHORS, wild), GuideFamily(ANCHORS, -wild))

    guides, _ = aggregate_guides([good[0], outlier, *good[1:], outlier], [0.9] * 7)

    difference = guides(target_lattice(17, 17)) - bent(0.06)(target_lattice(17, 17))
    assert np.abs(difference).max() < 0.005


def test_a_frame_counts_as_much_as_its_confidence() -> None:
    guides, confidence = aggregate_guides([bent(0.02), bent(0.02), bent(0.1)], [0.1, 0.1, 0.9])

    assert bend_of(guides) == pytest.approx(0.1)
    assert confidence == pytest.approx(0.1)


def test_without_any_confidence_the_frames_count_the_same() -> None:
    guides, confidence = aggregate_guides([bent(0.02), bent(0.04), bent(0.3)], [0.0, 0.0, 0.0])

    assert bend_of(guides) == pytest.approx(0.04)
    assert confidence == 0


def test_one_frame_comes_back_as_it_is() -> None:
    only = bent(0.05)

    guides, confidence = aggregate_guides([only], [0.4])

    assert np.array_equal(guides.rows.coefficients, only.rows.coefficients)
    assert confidence == 0.4


def test_two_frames_of_equal_confidence_meet_in_the_middle() -> None:
    guides, _ = aggregate_guides([bent(0.02), bent(0.06)], [0.5, 0.5])

    assert bend_of(guides) == pytest.approx(0.04)


def test_guides_that_do_not_belong_together_are_refused() -> None:
    with pytest.raises(InvalidGuides, match="different"):
        aggregate_guides([Guides.straight(), Guides.straight(degree=3)], [1, 1])
    with pytest.raises(InvalidGuides, match="no guides"):
        aggregate_guides([], [])


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
