from __future__ import annotations

import numpy as np
import pytest

from training.distortions import DistortionBatch
from training.random_distortions import KINDS, draw_distortions, fixed_distortion

pytestmark = pytest.mark.training

STEPS = np.linspace(-0.97, 0.97, 9)
X, Y = (a.reshape(1, -1) for a in np.meshgrid(STEPS, STEPS))


def grid(batch: DistortionBatch) -> tuple[np.ndarray, np.ndarray]:
    return np.repeat(X, batch.size, 0), np.repeat(Y, batch.size, 0)


@pytest.mark.parametrize("kind", range(len(KINDS)), ids=KINDS)
def test_bending_undoes_straightening(kind: int) -> None:
    """Both directions of every kind agree to a fifth of a pixel of a 256 picture, wherever a point has an image."""
    batch = draw_distortions(64, np.random.default_rng(kind), np.full(64, kind))
    x, y = grid(batch)
    target_x, target_y = batch.straighten(x, y)
    sample = np.repeat(np.arange(64), X.size)
    back_x, back_y, visible = batch.bend(
        target_x.ravel().astype(np.float32), target_y.ravel().astype(np.float32), sample
    )
    error = np.hypot(back_x - x.ravel(), back_y - y.ravel()) * 128
    assert visible.mean() > 0.9
    assert error[visible].max() < 0.2


def lzsl_pixels(a: np.ndarray) -> np.ndarray:
    """Isotropic coordinates of the 256 crop -> pixel indices of the 512 frame."""
    return a * 128 + 255.5


def test_the_radial_family_is_that_of_lzsl19() -> None:
    """r_u = r_d / (1 + lam r_d^2) about pixel 256 of 512."""
    lam = -1.1e-5
    x, y = fixed_distortion(division=lam * 128**2).straighten(X, Y)
    dx, dy = lzsl_pixels(X) - 256, lzsl_pixels(Y) - 256
    scale = 1 + lam * (dx**2 + dy**2)
    assert np.abs(lzsl_pixels(x) - (dx / scale + 256)).max() < 0.01
    assert np.abs(lzsl_pixels(y) - (dy / scale + 256)).max() < 0.01


def test_the_wave_family_is_that_of_lzsl19() -> None:
    """x_u = x_d + mag sin(4 pi y / 512)."""
    x, y = fixed_distortion(wave=(20 / 128, -np.pi * 0.5 / 128)).straighten(X, Y)
    expected = lzsl_pixels(X) + 20 * np.sin(4 * np.pi * lzsl_pixels(Y) / 512)
    assert np.abs(lzsl_pixels(x) - expected).max() < 1e-6
    assert np.abs(y - Y).max() < 1e-12


def test_pose_families_are_those_of_lzsl19() -> None:
    """Rotation and shear about pixel 256; the trapezoid's bottom corners move in by the inset."""
    px, py = lzsl_pixels(X) - 256, lzsl_pixels(Y) - 256
    angle = np.deg2rad(11)
    x, _ = fixed_distortion(degrees=11).straighten(X, Y)
    assert np.abs(lzsl_pixels(x) - 256 - (np.cos(angle) * px + np.sin(angle) * py)).max() < 1e-6
    x, y = fixed_distortion(shear=0.3).straighten(X, Y)
    assert np.abs(lzsl_pixels(x) - 256 - (px + 0.3 * py)).max() < 1e-6
    corner = np.array([[255 / 256]])
    x, y = fixed_distortion(inset=0.15).straighten(corner, corner)
    assert x.item() == pytest.approx((2 * 0.85 - 1) * 255 / 256)
    assert y.item() == pytest.approx((2 * 0.995 - 1) * 255 / 256)


def test_draws_are_reproducible() -> None:
    """The same generator gives the same distortions."""
    one, other = (draw_distortions(16, np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(one.undistorted_radius, other.undistorted_radius)
    np.testing.assert_array_equal(one.homography, other.homography)
