from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unbend_service.adapters.estimators.chain_features import (
    FEATURES,
    SAMPLES,
    ChainPoints,
    describe,
)


def arcs(bends: list[float], points: int = 30, picture: list[int] | None = None) -> ChainPoints:
    """Chains y = bend x^2 + offset, each from x = -0.6 to 0.6."""
    x = np.linspace(-0.6, 0.6, points)
    owners = picture or [0] * len(bends)
    rows = [bend * x * x + 0.1 * k for k, bend in enumerate(bends)]
    count = len(bends) * points
    return ChainPoints(
        x=np.tile(x, len(bends)).astype(np.float32),
        y=np.concatenate(rows).astype(np.float32),
        strength=np.full(count, 100, np.float32),
        starts=np.arange(count) % points == 0,
        picture=np.repeat(owners, points).astype(np.int64),
        half_extent=np.ones((max(owners) + 1, 2), np.float32),
        pixel=np.full(max(owners) + 1, 1 / 128, np.float32),
    )


def test_the_bend_of_a_chain_is_measured_in_reference_pixels() -> None:
    """A parabola's second Legendre coefficient is two thirds of its sagitta, whatever samples it."""
    features = describe(arcs([0.05])).features[0]
    second = np.sinh(features[3 * SAMPLES]) * 0.3
    assert second == pytest.approx(2 / 3 * 0.05 * 0.36 * 128, rel=0.05)


def test_the_direction_of_tracing_does_not_matter() -> None:
    """A chain read backwards has the same description."""
    forward = arcs([0.03])
    backward = ChainPoints(
        forward.x[::-1], forward.y[::-1], forward.strength, forward.starts, forward.picture, forward.half_extent,
        forward.pixel,
    )  # fmt: skip
    np.testing.assert_allclose(describe(forward).features, describe(backward).features, atol=2e-3)


def test_chains_are_told_apart_by_picture_and_sorted_by_length() -> None:
    """The longest chain of each picture comes first, and short ones are left out beyond the limit."""
    points = arcs([0.0, 0.1, 0.3, 0.2], picture=[0, 0, 0, 1])
    described = describe(points, limit=2)
    assert described.picture.tolist() == [0, 0, 1]
    assert described.slot.tolist() == [0, 1, 0]
    features, mask = described.padded(3)
    assert features.shape == (2, 3, FEATURES)
    assert mask.tolist() == [[1, 1, 0], [1, 0, 0]]


def test_a_mirrored_picture_mirrors_its_samples() -> None:
    """Mirroring changes the sign of x and the order of reading, nothing else."""
    one, other = describe(arcs([0.04])).features[0], describe(arcs([0.04]).mirrored()).features[0]
    np.testing.assert_allclose(one[:SAMPLES], -other[:SAMPLES][::-1], atol=1e-5)
    np.testing.assert_allclose(one[SAMPLES : 2 * SAMPLES], other[SAMPLES : 2 * SAMPLES][::-1], atol=1e-5)


def test_a_chain_is_described_the_same_in_any_company() -> None:
    """Longer chains beside it, or other pictures of the batch, take no part in its samples."""
    long, short = arcs([0.02]), arcs([0.2])
    short = replace(short, x=short.x / 4, y=short.y + short.x**3)
    per_point = ("x", "y", "strength", "starts", "picture")
    joined = {name: np.concatenate([getattr(long, name), getattr(short, name)]) for name in per_point}
    samples = slice(3 * SAMPLES)
    together = describe(replace(long, **joined)).features[1]
    np.testing.assert_allclose(together[samples], describe(short).features[0, samples], atol=1e-4)


@given(st.lists(st.floats(-2, 2, width=32), min_size=0, max_size=40), st.integers(1, 20))
def test_any_chains_have_finite_descriptions(heights: list[float], length: int) -> None:
    """However wild the points, no feature is NaN or infinite."""
    count = len(heights)
    points = ChainPoints(
        x=np.linspace(-1, 1, count, dtype=np.float32) if count else np.zeros(0, np.float32),
        y=np.array(heights, np.float32),
        strength=np.zeros(count, np.float32),
        starts=np.arange(count) % length == 0,
        picture=np.zeros(count, np.int64),
        half_extent=np.ones((1, 2), np.float32),
        pixel=np.full(1, 1 / 128, np.float32),
    )
    assert np.isfinite(describe(points).features).all()
