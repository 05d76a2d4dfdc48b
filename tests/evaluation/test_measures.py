"""What is measured, and how it is summed up."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from skimage.metrics import structural_similarity

from unbend_service.evaluation import tables
from unbend_service.evaluation.measures import displacement_px, map_errors, ssim_and_mse
from unbend_service.evaluation.suites import Measurement

POINTS = np.random.default_rng(0).uniform(-0.9, 0.9, (300, 2))


def test_a_shift_costs_its_length_and_nothing_up_to_a_homography() -> None:
    """In pixels of a picture whose long side is 256, whatever its aspect."""
    half_px = np.array([128.0, 96.0])
    shift = np.array([3 / 128, 4 / 96])
    everything, lens = map_errors(lambda points: points, POINTS, POINTS + shift, half_px)
    assert everything == pytest.approx(5)
    assert lens < 1e-3
    assert displacement_px(lambda points: points + shift, POINTS, half_px) == pytest.approx(5)


def test_a_bend_is_not_cured_by_a_homography() -> None:
    """Else nothing would be measured."""
    truth = POINTS * (1 - 0.1 * (POINTS**2).sum(1, keepdims=True))
    assert map_errors(lambda points: points, POINTS, truth, np.array([128.0, 128.0]))[1] > 1


def test_similarity_is_that_of_scikit_image() -> None:
    """Figures stand beside published ones, so the usual definition is meant."""
    rng = np.random.default_rng(3)
    a, b = rng.integers(0, 256, (2, 64, 64), dtype=np.uint8)
    b = (a // 2 + b // 2).astype(np.uint8)
    shown = np.zeros((64, 64), bool)
    shown[8:-8, 8:-8] = True
    _, expected = structural_similarity(a, b, full=True, data_range=255)
    similarity, squared = ssim_and_mse(a, b, shown)
    assert similarity == pytest.approx(expected[shown].mean(), abs=1e-9)
    assert squared == pytest.approx(((a.astype(float) - b) ** 2)[shown].mean())


def measurement(**changes: object) -> Measurement:
    base = Measurement(
        group="barrel",
        picture=0,
        nothing_px=6.0,
        error_px=3.0,
        lens_nothing_px=4.0,
        lens_px=1.0,
        applied_px=1.0,
        moved_px=2.0,
        applied_moved_px=2.0,
        confidence=0.9,
        applies=True,
        expected_error_px=1.0,
        seconds=0.01,
    )
    return dataclasses.replace(base, **changes)


def test_removed_distortion_is_averaged_over_bent_cameras() -> None:
    """A straight camera has none to remove; one that is left alone removes none."""
    rows = tables.lens_rows(
        [
            measurement(group="rational-1"),
            measurement(group="fisheye-1", applied_px=4.0),
            measurement(group="straight-1", lens_nothing_px=0.0, lens_px=0.3, applied_px=0.0),
        ]
    )
    assert tables.removed_share(rows, applied=False) == pytest.approx(0.75)
    assert tables.removed_share(rows) == pytest.approx(0.375)
    assert [row.harmed for row in rows] == [0, 0, 0]


def test_harm_is_counted_where_it_is_applied() -> None:
    """Not what was estimated and discarded."""
    harmed = measurement(group="straight-1", lens_nothing_px=0.0, lens_px=0.3, applied_px=0.3)
    assert tables.lens_rows([harmed])[0].harmed == 1
    assert tables.lens_rows([dataclasses.replace(harmed, applied_px=0.0)])[0].harmed == 0


def test_the_oblique_ratio_compares_twins() -> None:
    """Undistorted pictures do not dilute it."""
    views = [
        measurement(group="upright barrel", lens_px=0.5),
        measurement(group="oblique barrel", lens_px=0.75),
        measurement(group="upright none", lens_px=9.0),
        measurement(group="oblique none", lens_px=0.0),
    ]
    assert tables.oblique_ratio(views) == pytest.approx(1.5)


def test_a_threshold_leaves_doubtful_pictures_alone() -> None:
    """What it spares undistorted pictures, and what it costs bent ones."""
    straight = [measurement(confidence=0.2, moved_px=3.0), measurement(confidence=0.9, moved_px=0.1)]
    bent = [measurement(confidence=0.95), measurement(confidence=0.4)]
    moved, corrected, left, nothing = tables.harm_at(straight, bent, 0.5)
    assert moved.tolist() == [0.0, 0.1]
    assert (corrected, left, nothing) == (0.5, 2.5, 4.0)
