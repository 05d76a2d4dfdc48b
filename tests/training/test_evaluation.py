from __future__ import annotations

import numpy as np
import pytest

from training.calibration import calibrate, reliability
from training.evaluation import Measurement, map_errors, table, true_correspondences
from training.labels import ANCHORS, NODES, evaluation_points, fit_labels
from training.protocol import FAMILIES, cases, draw_family
from unbend_service.adapters.estimators.isotropic_guides import GuideFrame
from unbend_service.adapters.estimators.lineset import Evidence

pytestmark = pytest.mark.training


def photograph(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (400, 500, 3), dtype=np.uint8)


@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_distorts_reproducibly(family: str) -> None:
    """The same photographs meet the same distortions each time; a distorted picture is 256x256 grey."""
    one, other = (next(cases(family, [photograph(0)])) for _ in range(2))
    np.testing.assert_array_equal(one.picture, other.picture)
    assert one.picture.shape == (256, 256)


def test_calibration_sees_other_distortions_than_evaluation() -> None:
    """A seed changes the draw."""
    public, seeded = next(cases("barrel", [photograph(0)])), next(cases("barrel", [photograph(0)], seed=1))
    assert (public.picture != seeded.picture).any()


def test_an_undistorted_case_is_the_middle_of_the_photograph() -> None:
    """Pixel for pixel, so that nothing but the lens is measured."""
    case = next(cases("none", [np.full((512, 512, 3), 7, np.uint8)]))
    assert (case.picture == 7).all()


@pytest.mark.parametrize("family", ["rotation", "shear", "projective"])
def test_a_pose_costs_nothing_up_to_a_homography(family: str) -> None:
    """Doing nothing about a pose is wrong by pixels, and exactly right once the best homography is allowed."""
    target, truth = true_correspondences(draw_family(family, np.random.default_rng(4)))
    overall, nonlinear = map_errors(lambda points: points, target, truth)
    assert overall > 2
    assert nonlinear < 0.01


@pytest.mark.parametrize("family", ["barrel", "pincushion", "wave", "mixed"])
def test_guides_fitted_to_the_truth_have_hardly_an_error(family: str) -> None:
    """The measure and the labels speak of the same map."""
    distortion = draw_family(family, np.random.default_rng(2))
    x, y = evaluation_points(np.ones((1, 2)))
    s, t = distortion.straighten(x, y)
    weight = np.where(np.maximum(np.abs(s), np.abs(t)) < 1.05, 1.0, 0.02)
    values = fit_labels(x, y, s, t, weight, 1e-6)[0].reshape(2, len(ANCHORS), len(NODES))
    overall, nonlinear = map_errors(GuideFrame(NODES, ANCHORS).guides(values), *true_correspondences(distortion))
    assert overall < 0.3
    assert nonlinear < 0.3


def measurement(error: float, displacement: float, *, better: bool) -> Measurement:
    return Measurement(
        family="barrel",
        overall_nothing=5.0,
        overall=2.0,
        nonlinear_nothing=2.0,
        nonlinear=1.0 if better else 3.0,
        applied=2.0,
        strength=0.0,
        evidence=Evidence(error, displacement, 0.1, 50, 0.1, 0.0, 0.0),
        confidence=0.9,
    )


def test_calibration_learns_what_speaks_for_an_estimate() -> None:
    """Large displacements with small expected errors were better, the others worse: so the confidence says."""
    rng = np.random.default_rng(0)
    measurements = [measurement(e, d, better=d > 1.5 * e) for e, d in np.exp(rng.normal(size=(400, 2)))]
    weights = np.array(calibrate(measurements).weights)
    sure, unsure = Evidence(0.1, 3.0, 0.1, 50, 0.1, 0.0, 0.0), Evidence(3.0, 0.1, 0.1, 50, 0.1, 0.0, 0.0)
    assert sure.inputs() @ weights > 2
    assert unsure.inputs() @ weights < -2


def test_reliability_compares_what_was_said_with_what_happened() -> None:
    """Each row: mean confidence, share that became better, number of pictures."""
    rows = reliability(np.array([0.1, 0.1, 0.99, 0.99]), np.array([0.0, 1.0, 1.0, 1.0]))
    assert rows == [(pytest.approx(0.1), 0.5, 2), (pytest.approx(0.99), 1.0, 2)]


def test_the_table_has_the_do_nothing_line_beside_every_figure() -> None:
    """What is left alone counts as doing nothing."""
    text = table([measurement(1.0, 1.0, better=True)], "a title")
    assert "| barrel | 1 | 5.00 | 2.00 | 2.00 | 2.00 | 1.00 | 1.00 | 2.00 | 0.00 | 0.00 |" in text
