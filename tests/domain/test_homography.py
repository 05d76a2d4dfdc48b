from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.domain.lenses import BARREL, PIXEL, radial, trapezoid_matrix
from unbend_service.domain.errors import InvalidGrid
from unbend_service.domain.homography import apply_homography, fit_homography, plane_part, without_plane_part
from unbend_service.domain.maps import Float64, target_lattice

LATTICE = target_lattice(17, 17)


@st.composite
def homographies(draw: st.DrawFn) -> Float64:
    """Moderate ones: the picture stays in sight, rotated by less than 30 degrees, with some perspective."""
    angle, size = draw(st.floats(-0.5, 0.5)), draw(st.floats(0.7, 1.4))
    c, s = size * np.cos(angle), size * np.sin(angle)
    shift = st.floats(-0.15, 0.15)
    return np.array(
        [
            [c + draw(shift), -s, draw(shift)],
            [s, c, draw(shift)],
            [draw(shift), draw(shift), 1.0],
        ]
    )


@given(homographies())
def test_exact_correspondences_give_the_homography(matrix: Float64) -> None:
    """What was applied is found, to rounding."""
    target = LATTICE.reshape(-1, 2)
    found = fit_homography(target, apply_homography(matrix, target))
    np.testing.assert_allclose(found, matrix, atol=1e-7)


@given(homographies(), st.integers(0, 2**32 - 1))
def test_a_tenth_of_nonsense_is_ignored(matrix: Float64, seed: int) -> None:
    """One correspondence in ten may be anywhere: the plane moves by less than half a pixel."""
    rng = np.random.default_rng(seed)
    target = LATTICE.reshape(-1, 2)
    source = apply_homography(matrix, target)
    wrong = rng.choice(len(source), len(source) // 10, replace=False)
    source[wrong] += rng.uniform(-0.5, 0.5, (len(wrong), 2))
    found = apply_homography(fit_homography(target, source), target)
    assert np.hypot(*(found - apply_homography(matrix, target)).T).max() < 0.5 * PIXEL


def test_weights_say_what_counts() -> None:
    """Correspondences of weight 0 are not heard."""
    target = LATTICE.reshape(-1, 2)
    source = np.where(target[:, :1] > 0, target + 0.3, target)
    found = fit_homography(target, source, (target[:, 0] <= 0).astype(float))
    np.testing.assert_allclose(found, np.eye(3), atol=1e-9)


@pytest.mark.parametrize("points", [3, 20])
def test_points_on_a_line_are_refused(points: int) -> None:
    """Too few points, or points on one line, determine no plane."""
    target = np.linspace([-1, -1], [1, 1], points)
    with pytest.raises(InvalidGrid, match="on a line"):
        fit_homography(target, target)


@settings(max_examples=20)
@given(homographies())
def test_the_nonlinear_part_of_a_homography_is_nothing(matrix: Float64) -> None:
    """A picture that was only tilted, turned or seen in perspective is left alone."""
    nonlinear = without_plane_part(lambda target: apply_homography(matrix, target))
    np.testing.assert_allclose(nonlinear(LATTICE), LATTICE, atol=1e-6)


@settings(max_examples=20)
@given(homographies(), st.floats(BARREL / 2, 0.1))
def test_the_nonlinear_part_keeps_the_lens(matrix: Float64, strength: float) -> None:
    """Of a lens behind a homography the lens stays: up to a homography, what is left is the lens alone."""
    lens = radial(strength)
    nonlinear = without_plane_part(lambda target: lens(apply_homography(matrix, target)))
    source = nonlinear(LATTICE).reshape(-1, 2)
    straightened = source / (1 + strength * (source**2).sum(axis=1, keepdims=True))  # the lens' own forward map
    inner = (np.abs(source) <= 1).all(axis=1)
    plane = fit_homography(LATTICE.reshape(-1, 2)[inner], straightened[inner])
    left = apply_homography(plane, LATTICE.reshape(-1, 2)[inner]) - straightened[inner]
    assert np.hypot(*left.T).max() < 1e-6


@pytest.mark.parametrize("strength", [BARREL, BARREL / 2, 0.1, 0.2])
def test_the_nonlinear_part_of_a_lens_keeps_its_framing(strength: float) -> None:
    """Straightening a lens neither shifts nor turns the picture, and zooms it by 4 % at most."""
    nonlinear = without_plane_part(radial(strength))
    np.testing.assert_allclose(plane_part(nonlinear), np.eye(3), atol=0.04)
    np.testing.assert_allclose(nonlinear(np.zeros(2)), 0, atol=1e-6)


def test_points_behind_the_horizon_stay_out_of_sight() -> None:
    """What has no image is put far out, on the side where it would vanish."""
    matrix = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0.8, 1]])
    near, horizon, behind = apply_homography(matrix, np.array([[0.1, -1.2], [0.1, -1.25], [0.1, -2.0]]))
    assert -40 < near[1] < -1
    assert horizon[1] < -100
    assert behind[1] < -100
    np.testing.assert_allclose(
        apply_homography(-matrix, np.array([0.3, 0.4])), apply_homography(matrix, np.array([0.3, 0.4]))
    )


def test_known_corners_are_met() -> None:
    """The trapezoid's corners come from the picture's corners."""
    target = np.array([[-1, -0.99], [1, -0.99], [0.6, 0.99], [-0.6, 0.99]])
    np.testing.assert_allclose(
        apply_homography(trapezoid_matrix(0.2), target), [[-1, -1], [1, -1], [1, 1], [-1, 1]], atol=1e-12
    )


def test_a_map_out_of_sight_has_no_plane_part() -> None:
    """A map that shows almost nothing, or collapses to a line, is refused by name."""
    with pytest.raises(InvalidGrid, match="almost nothing"):
        plane_part(lambda target: target + 5)
    with pytest.raises(InvalidGrid):
        without_plane_part(lambda target: target * [1, 0])


@settings(max_examples=20)
@given(homographies(), st.integers(0, 2**32 - 1))
def test_noise_is_averaged_as_a_decomposition_of_all_equations_would(matrix: Float64, seed: int) -> None:
    """Normal equations cost no accuracy: with noise everywhere the plane is the least squares one to a millionth."""
    rng = np.random.default_rng(seed)
    target = LATTICE.reshape(-1, 2)
    source = apply_homography(matrix, target) + rng.normal(0, 1e-3, target.shape)
    found = fit_homography(target, source)
    (x, y), (u, v) = target.T, source.T
    depth = np.abs(found[2, 0] * x + found[2, 1] * y + 1)
    residual = np.hypot(*(apply_homography(found, target) - source).T)
    share = 1 / depth / np.sqrt(1 + (residual / (2.4 * np.median(residual))) ** 2)
    zero, one = np.zeros_like(x), np.ones_like(x)
    equations = np.concatenate(
        [
            np.stack([x, y, one, zero, zero, zero, -u * x, -u * y], axis=1),
            np.stack([zero, zero, zero, x, y, one, -v * x, -v * y], axis=1),
        ]
    )
    both = np.concatenate([share, share])
    expected, *_ = np.linalg.lstsq(equations * both[:, None], source.T.reshape(-1) * both, rcond=None)
    np.testing.assert_allclose(found.reshape(-1)[:8], expected, atol=1e-6)
