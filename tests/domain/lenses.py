"""Known distortions with closed-form backward maps, in centred coordinates.

The families and ranges of the accuracy measurements: a 256x256 crop of a 512x512 photograph.
"""

from __future__ import annotations

import numpy as np

from unbend_service.domain.homography import apply_homography
from unbend_service.domain.maps import BackwardMap, Float64, pixel_centres

BARREL = -0.2048
PINCUSHION = 0.3523
WAVE = 0.25
PIXEL = 2 / 256


def radial(strength: float, centre: float = 0.0) -> BackwardMap:
    """One-parameter division model, target = source / (1 + strength r^2); NaN where there is no source."""

    def backward(target: Float64) -> Float64:
        offset = target - centre
        squared = (offset**2).sum(axis=-1, keepdims=True)
        with np.errstate(invalid="ignore"):
            return np.asarray(2 * offset / (1 + np.sqrt(1 - 4 * strength * squared)) + centre)

    return backward


def wave(amplitude: float) -> BackwardMap:
    """One period of a sideways wave."""

    def backward(target: Float64) -> Float64:
        x, y = target[..., 0], target[..., 1]
        return np.stack([x - amplitude * np.sin(np.pi * y), y], axis=-1)

    return backward


def affine(matrix: Float64, shift: Float64) -> BackwardMap:
    return lambda target: np.asarray(target @ matrix.T + shift)


def rotation(degrees: float) -> BackwardMap:
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return affine(np.array([[c, -s], [s, c]]), np.zeros(2))


def shear(k: float) -> BackwardMap:
    return affine(np.array([[1.0, -k], [0.0, 1.0]]), np.zeros(2))


def trapezoid_matrix(inset: float) -> Float64:
    """Homography target -> source of a picture whose lower corners were moved inwards by ``inset`` of its width."""
    source = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], float)
    target = np.array([(-1, -0.99), (1, -0.99), (1 - 2 * inset, 0.99), (-1 + 2 * inset, 0.99)])
    rows, right = [], []
    for (x, y), (u, v) in zip(target, source, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
        right += [u, v]
    return np.append(np.linalg.solve(np.array(rows), np.array(right)), 1.0).reshape(3, 3)


def projective(inset: float) -> BackwardMap:
    matrix = trapezoid_matrix(inset)
    return lambda target: apply_homography(matrix, target)


def error_px(found: BackwardMap, true: BackwardMap, points: int = 96) -> Float64:
    """(n,) distances between two maps, px at 256, at the pixel centres whose true source is visible."""
    centres = pixel_centres(points)
    target = np.stack(np.meshgrid(centres, centres), axis=-1).reshape(-1, 2)
    source = true(target)
    with np.errstate(invalid="ignore"):
        visible = (np.abs(source) <= 1).all(axis=-1)
    return np.hypot(*(found(target[visible]) - source[visible]).T) / PIXEL
