"""Homographies of the target plane, in batches: rotation, shear, the LZSL19 trapezoid, free ones, natural tilt.

float64 (B, 3, 3), isotropic frame.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]

LZSL_CENTRE = 0.5 / 128
"""LZSL19 puts its centre at pixel index 256 of 512, half a pixel from the middle of the picture."""
LZSL_CROP_CORNER = 255.0


def _about(matrices: Float64, centre: float) -> Float64:
    there = np.array([[1, 0, -centre], [0, 1, -centre], [0, 0, 1.0]])
    return np.asarray(np.linalg.inv(there) @ matrices @ there)


def rotations(degrees: Float64) -> Float64:
    angle = np.radians(degrees)
    matrices = np.tile(np.eye(3), (len(angle), 1, 1))
    matrices[:, 0, 0] = matrices[:, 1, 1] = np.cos(angle)
    matrices[:, 0, 1] = np.sin(angle)
    matrices[:, 1, 0] = -np.sin(angle)
    return _about(matrices, LZSL_CENTRE)


def shears(shear: Float64) -> Float64:
    matrices = np.tile(np.eye(3), (len(shear), 1, 1))
    matrices[:, 0, 1] = shear
    return _about(matrices, LZSL_CENTRE)


def trapezoids(inset: Float64) -> Float64:
    """LZSL19 "projective": the crop's square onto a trapezoid whose bottom corners are moved in by `inset`."""
    zero, one = np.zeros_like(inset), np.ones_like(inset)
    corners = np.stack([zero, zero + 0.005, one, zero + 0.005, 1 - inset, zero + 0.995, inset, zero + 0.995], 1)
    return unit_square_to(corners.reshape(-1, 4, 2))


def unit_square_to(corners: Float64) -> Float64:
    """Homographies (B, 3, 3), isotropic, that take the unit square (0,0), (1,0), (1,1), (0,1) to `corners` (B, 4, 2);
    the unit square's sides are the first and last pixel centres of a 256 crop, as in LZSL19."""
    size = len(corners)
    system = np.zeros((size, 8, 8))
    right = np.zeros((size, 8))
    for i, (p, q) in enumerate(((0, 0), (1, 0), (1, 1), (0, 1))):
        x, y = corners[:, i, 0], corners[:, i, 1]
        system[:, 2 * i, :3] = system[:, 2 * i + 1, 3:6] = (p, q, 1)
        system[:, 2 * i, 6], system[:, 2 * i, 7], right[:, 2 * i] = -x * p, -x * q, x
        system[:, 2 * i + 1, 6], system[:, 2 * i + 1, 7], right[:, 2 * i + 1] = -y * p, -y * q, y
    solved = np.linalg.solve(system, right[..., None])[..., 0]
    matrices = np.concatenate([solved, np.ones((size, 1))], 1).reshape(size, 3, 3)
    edge = LZSL_CROP_CORNER / 256
    to_isotropic = np.array([[2 * edge, 0, -edge], [0, 2 * edge, -edge], [0, 0, 1.0]])
    return np.asarray(to_isotropic @ matrices @ np.linalg.inv(to_isotropic))


def without_scale_and_shift(matrices: Float64) -> Float64:
    """The same homographies followed by the shift and scale that keep the origin and the area around it: neither can
    be seen in a picture, so no network is asked for them."""
    matrices = matrices / matrices[:, 2:, 2:]
    shift = matrices[:, :2, 2]
    jacobian = matrices[:, :2, :2] - shift[:, :, None] * matrices[:, 2:, :2]
    scale = np.sqrt(np.abs(np.linalg.det(jacobian)))
    back = np.tile(np.eye(3), (len(matrices), 1, 1))
    back[:, 0, 0] = back[:, 1, 1] = 1 / scale
    back[:, :2, 2] = -shift / scale[:, None]
    return np.asarray(back @ matrices)


def natural_tilts(size: int, share: float, rng: np.random.Generator) -> Float64:
    """Homographies (B, 3, 3) of a camera held a little askew, for `share` of the samples; these are never labelled."""
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) + rng.normal(size=(size, 4, 2)).clip(-2, 2) * 0.04
    tilt = without_scale_and_shift(unit_square_to(corners)) @ rotations((rng.normal(size=size) * 4).clip(-10, 10))
    return np.where((rng.random(size) < share)[:, None, None], tilt, np.eye(3))
