"""Weighing edge chains against a network's guides: which of nothing, a lens, or the guides themselves."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from unbend_service.adapters.estimators.chains import EdgeChains, extract
from unbend_service.adapters.estimators.guides_view import GuidesView
from unbend_service.adapters.estimators.radial import Refinement, refine
from unbend_service.adapters.estimators.radial_family import guides_of_lens, is_lens, straighten
from unbend_service.domain.decision import spin_grid
from unbend_service.domain.fitting import fit_guides
from unbend_service.domain.guides import Guides
from unbend_service.domain.homography import apply_homography, fit_homography
from unbend_service.domain.maps import BackwardMap, Float64, target_lattice
from unbend_service.domain.records import Correct

SIDE = 256
PIXELS = SIDE / 2


def draw(curves: list[Float64], width: int = SIDE, height: int = SIDE, thickness: int = 3) -> EdgeChains:
    """Edge chains of a picture of `curves`, each (n, 2) isotropic source points."""
    picture: npt.NDArray[np.uint8] = np.full((height, width), 200, np.uint8)
    for curve in curves:
        pixels = curve * max(width, height) / 2 + (width / 2 - 0.5, height / 2 - 0.5)
        points = np.round(pixels * 16).astype(np.int32)
        cv2.polylines(picture, [points], False, 60, thickness, cv2.LINE_AA, shift=4)
    return extract(picture)


def lines(rng: np.random.Generator, count: int = 10) -> list[Float64]:
    """Straight lines across the target that do not cross, (400, 2) each, isotropic: a fence on the left, planks on
    the right."""
    long, short = np.linspace(-1.8, 1.8, 400), np.linspace(0.05, 1.8, 400)
    drawn = []
    for place in np.linspace(-1.0, 1.0, count):
        drawn.append(np.stack([place / 2 - 0.55 + rng.normal(0, 0.02) * long, long], axis=1))
        drawn.append(np.stack([short, 1.1 * place + rng.normal(0, 0.05) * short], axis=1))
    return drawn


def seen_through(lens: Float64, target: Float64) -> Float64:
    """Source points of those target points (n, 2) that the lens shows, isotropic, from a table of radii."""
    source_radius = np.linspace(0, 1.5, 4000)
    square = source_radius**2
    radius = source_radius / (1 + square * (lens[0] + square * lens[1]))
    offset = target - lens[2:]
    distance = np.hypot(*offset.T)
    scale = np.interp(distance, radius, source_radius) / np.maximum(distance, 1e-9)
    return np.asarray((lens[2:] + offset * scale[:, None])[distance < radius[-1]])


def nonlinear_error(guides: Guides, straightened: Float64, source: Float64) -> float:
    """Mean distance, px of a 256 picture, between guides and truth up to a homography of the target."""
    found = GuidesView(guides, 1.0, 1.0).straighten(source)
    aligned = apply_homography(fit_homography(straightened, found), straightened)
    return float(np.hypot(*(found - aligned).T).mean() * PIXELS)


def lens_error(refined: Refinement, lens: Float64) -> float:
    source = target_lattice(15, 15, 0.93).reshape(-1, 2)
    return nonlinear_error(refined.guides, straighten(lens, source), source)


def wave(target: Float64) -> Float64:
    """Backward map of a wave of 16 px of 256."""
    return np.stack([target[..., 0] - 0.125 * np.sin(np.pi * target[..., 1]), target[..., 1]], axis=-1)


def guides_of_map(backward: BackwardMap) -> Guides:
    target = target_lattice(31, 31, 1.2).reshape(-1, 2)
    source = backward(target)
    shown = (np.abs(source) <= 1.05).all(axis=1)
    return fit_guides(source[shown], target[shown])


def displacement(guides: Guides) -> float:
    source = target_lattice(15, 15, 0.93).reshape(-1, 2)
    return nonlinear_error(guides, source, source)


#: Lens, and to how many pixels it has to be found.
LENSES = {
    "barrel": ((-0.15, 0.0, 0.0, 0.0), 0.1),
    "pincushion": ((0.2, 0.0, 0.0, 0.0), 0.1),
    "two terms": ((-0.2, 0.05, 0.0, 0.0), 0.1),
    "off-centre": ((-0.2, 0.0, 0.12, -0.08), 0.25),
}


@pytest.mark.parametrize("seed", [3, 4])
@pytest.mark.parametrize("name", LENSES)
def test_a_lens_is_recovered_to_a_tenth_of_a_pixel_from_a_rough_guess(name: str, seed: int) -> None:
    """The guess is one or more pixels off and knows no centre; the chains of straight lines mend that."""
    numbers, tolerance = LENSES[name]
    lens = np.array(numbers)
    chains = draw([seen_through(lens, line) for line in lines(np.random.default_rng(seed))])
    guess = guides_of_lens(lens * (0.67, 0, 0, 0), np.eye(3), 1.0, 1.0)
    source = target_lattice(15, 15, 0.93).reshape(-1, 2)
    refined = refine(chains, guess, nonlinear_error(guess, straighten(lens, source), source))
    assert refined.kind == "radial"
    assert lens_error(refined, lens) < tolerance
    assert refined.expected_error < 0.5


def test_the_pose_that_the_network_saw_is_kept() -> None:
    """Rotation and perspective of the guides are still there after the lens was refined, for `all` corrections."""
    lens = np.array([-0.15, 0.0, 0.0, 0.0])
    pose = np.array([[0.99, -0.1, 0.02], [0.1, 0.99, -0.03], [0.05, 0.08, 1.0]])
    chains = draw([seen_through(lens, line) for line in lines(np.random.default_rng(5))])
    refined = refine(chains, guides_of_lens(0.8 * lens, pose, 1.0, 1.0), 0.6)
    source = target_lattice(15, 15, 0.8).reshape(-1, 2)
    found = GuidesView(refined.guides, 1.0, 1.0).straighten(source)
    expected = apply_homography(pose, straighten(lens, source))
    assert refined.kind == "radial"
    assert np.hypot(*(found - expected).T).mean() * PIXELS < 1.0


def test_a_strong_pincushion_seen_askew_is_still_straightened() -> None:
    """A network that believes in a strong shear does not spoil the lens: the nonlinear grid is that of the lens."""
    lens = np.array([0.3, 0.0, 0.0, 0.0])
    shear = np.array([[0.99, 0.4, 0.0], [0.0, 0.99, 0.0], [0.0, 0.0, 1.0]])
    chains = draw([seen_through(lens, line) for line in lines(np.random.default_rng(5))])
    refined = refine(chains, guides_of_lens(0.95 * lens, shear, 1.0, 1.0), 0.8)
    upright = guides_of_lens(lens, np.eye(3), 1.0, 1.0)
    found, expected = (spin_grid(guides, Correct.NONLINEAR, 17).source for guides in (refined.guides, upright))
    shown = (np.abs(expected) <= 1).all(axis=-1)
    assert np.hypot(*(found - expected)[shown].T).mean() * PIXELS < 0.25


def test_a_wide_picture_has_round_lenses_too() -> None:
    """In a 16:9 picture circles stay circles: the lens lives in the isotropic frame, the guides in the centred one."""
    lens = np.array([-0.2, 0.0, 0.0, 0.0])
    chains = draw([seen_through(lens, line) for line in lines(np.random.default_rng(4))], 256, 144)
    refined = refine(chains, guides_of_lens(0.6 * lens, np.eye(3), 1.0, 144 / 256), 1.0)
    source = target_lattice(15, 15, 0.93).reshape(-1, 2) * (1.0, 144 / 256)
    found = GuidesView(refined.guides, 1.0, 144 / 256).straighten(source)
    truth = straighten(lens, source)
    error = np.hypot(*(found - apply_homography(fit_homography(truth, found), truth)).T).mean() * PIXELS
    assert refined.kind == "radial"
    assert error < 0.15


def test_an_undistorted_picture_stays_as_it_is() -> None:
    """Straight lines and a network that saw a little of a barrel: nothing is moved."""
    chains = draw(lines(np.random.default_rng(7)))
    refined = refine(chains, guides_of_lens(np.array([-0.02, 0, 0, 0]), np.eye(3), 1.0, 1.0), 0.4)
    assert refined.kind == "identity"
    assert displacement(refined.guides) < 0.02


def test_natural_curves_are_not_straightened() -> None:
    """A picture of circles says nothing of the lens: a network that is content with it is believed."""
    rng = np.random.default_rng(11)
    angle = np.linspace(0, 2 * np.pi, 400)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    curves = [rng.uniform(-0.6, 0.6, 2) + rng.uniform(0.15, 0.4) * circle for _ in range(10)]
    refined = refine(draw(curves), Guides.straight(), 0.5)
    assert displacement(refined.guides) < 0.1


def test_a_wave_is_left_to_the_guides() -> None:
    """No lens explains a wave: the network's guides come back untouched."""
    chains = draw([wave(line) for line in lines(np.random.default_rng(13))])
    guides = guides_of_map(wave)
    refined = refine(chains, guides, 0.6)
    assert refined.kind == "guides"
    assert refined.guides is guides


@pytest.mark.parametrize("count", [0, 1])
def test_with_few_chains_the_guides_come_back_as_they_are(count: int) -> None:
    """A picture with hardly an edge has nothing to add."""
    guides = guides_of_lens(np.array([-0.1, 0, 0, 0]), np.eye(3), 1.0, 1.0)
    refined = refine(draw(lines(np.random.default_rng(1), count)), guides, 0.8)
    assert refined.guides is guides
    assert refined.kind == "guides"
    assert refined.expected_error == pytest.approx(0.8)


def test_the_probabilities_add_up_and_name_the_winner() -> None:
    """What is reported of the three kinds is a distribution."""
    chains = draw(lines(np.random.default_rng(7)))
    refined = refine(chains, Guides.straight(), 0.4)
    assert sum(refined.probabilities.values()) == pytest.approx(1.0)
    assert set(refined.probabilities) == {"identity", "radial", "guides"}


def test_a_lens_that_folds_is_no_lens() -> None:
    """Lenses are kept to those whose radius keeps growing over the whole picture."""
    assert is_lens(np.array([-0.2, 0.0, 0.0, 0.0]))
    assert not is_lens(np.array([-0.6, 0.0, 0.0, 0.0]))
    assert not is_lens(np.array([0.6, 0.2, 0.0, 0.0]))
    assert not is_lens(np.array([0.0, 0.0, 0.9, 0.0]))
