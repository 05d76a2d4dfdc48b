"""The plane part of a map: the homography that fits a backward map best, and the map without it."""

from __future__ import annotations

import numpy as np

from unbend_service.domain.errors import InvalidGrid
from unbend_service.domain.maps import BackwardMap, Float64, target_lattice

_LATTICE_POINTS = 33


def apply_homography(matrix: Float64, points: Float64) -> Float64:
    """(3, 3) matrix on (..., 2) points of the plane it was fitted in.

    Points on the horizon of the middle or behind it have no image; they are put far out instead of coming back from
    the other side.
    """
    projected = points @ matrix[:, :2].T + matrix[:, 2]
    side = -1.0 if matrix[2, 2] < 0 else 1.0
    return np.asarray(projected[..., :2] / (np.maximum(projected[..., 2:] * side, 1e-3) * side))


def fit_homography(target: Float64, source: Float64, weights: Float64 | None = None) -> Float64:
    """Robust least squares homography ``source ~ H(target)``.

    The algebraic error is reweighted to the geometric one and by a Cauchy weight of its median (Hartley & Zisserman,
    *Multiple View Geometry*, 2nd ed., sections 4.1 and 4.7).

    Args:
        target, source: (n, 2) float64 centred coordinates, n >= 4.
        weights: (n,) float64 >= 0; equal weights if left out.

    Returns:
        (3, 3) float64, ``[2, 2] == 1``.

    Raises:
        InvalidGrid: the points do not determine a homography.
    """
    x, y = target.T
    u, v = source.T
    zero, one = np.zeros_like(x), np.ones_like(x)
    equations = np.concatenate(
        [
            np.stack([x, y, one, zero, zero, zero, -u * x, -u * y], axis=1),
            np.stack([zero, zero, zero, x, y, one, -v * x, -v * y], axis=1),
        ]
    )
    right = np.concatenate([u, v])
    base = np.ones_like(x) if weights is None else weights
    weight = base
    matrix = np.eye(3)
    for _ in range(12):
        both = np.sqrt(np.concatenate([weight, weight]))
        solution, _, rank, _ = np.linalg.lstsq(equations * both[:, None], right * both, rcond=None)
        if rank < 8 or not np.isfinite(solution).all():
            raise InvalidGrid("The map has no plane part: its points lie on a line.")
        previous, matrix = matrix, np.append(solution, 1.0).reshape(3, 3)
        if np.abs(matrix - previous).max() < 1e-10:
            break
        residual = np.hypot(*(apply_homography(matrix, target) - source).T)
        scale = max(2.4 * float(np.median(residual)), 1e-6)
        denominator = np.maximum(np.abs(matrix[2, 0] * x + matrix[2, 1] * y + 1), 0.1)
        weight = base / denominator**2 / (1 + (residual / scale) ** 2)
    return matrix


def plane_part(backward: BackwardMap) -> Float64:
    """The homography H that fits ``backward`` best over the visible part of the target lattice, (3, 3) float64."""
    target = target_lattice(_LATTICE_POINTS, _LATTICE_POINTS).reshape(-1, 2)
    source = backward(target)
    visible = (np.abs(source) <= 1.1).all(axis=1)
    if visible.sum() < 16:
        raise InvalidGrid("The map shows almost nothing of the source.")
    return fit_homography(target[visible], source[visible])


def without_plane_part(backward: BackwardMap) -> BackwardMap:
    """``backward`` after H^-1: straight lines stay straight, framing, tilt and perspective stay as they were."""
    matrix = plane_part(backward)
    if abs(np.linalg.det(matrix)) < 1e-6:
        raise InvalidGrid("The plane part of the map cannot be inverted.")
    inverse = np.asarray(np.linalg.inv(matrix), dtype=np.float64)

    def nonlinear(target: Float64) -> Float64:
        return backward(apply_homography(inverse, np.asarray(target, dtype=np.float64)))

    return nonlinear
