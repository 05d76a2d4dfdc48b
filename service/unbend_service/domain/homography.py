"""The plane part of a map: the homography that fits a backward map best, and the map without it."""

from __future__ import annotations

import numpy as np

from unbend_service.domain.errors import InvalidGrid
from unbend_service.domain.maps import BackwardMap, Float64, target_lattice

_LATTICE_POINTS = 33
#: Points nearer to the horizon are put far out.
_HORIZON = 1e-3
#: Least eigenvalue of the normal equations, as a share of the greatest, with which they have one solution.
_LEAST_RANK = 1e-12
_SYMMETRIC = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""Where x^2, xy, x, y^2, y, 1 stand in the outer product of (x, y, 1) with itself."""
_ONE, _BY_U, _BY_V, _BY_SQUARE = (_SYMMETRIC + 6 * i for i in range(4))
"""Where its products with 1, u, v and u^2 + v^2 stand among `_products`."""
_NORMAL_PLACES = np.block(
    [
        [_ONE, _ONE, _BY_U[:, :2]],
        [_ONE, _ONE, _BY_V[:, :2]],
        [_BY_U[:2], _BY_V[:2], _BY_SQUARE[:2, :2]],
    ]
)
_NORMAL_SIGNS = np.kron([[1.0, 0, -1], [0, 1, -1], [-1, -1, 1]], np.ones((3, 3)))[:8, :8]
_RIGHT_PLACES = np.concatenate([_BY_U[:, 2], _BY_V[:, 2], _BY_SQUARE[:2, 2]])
_RIGHT_SIGNS = np.array([1.0, 1, 1, 1, 1, 1, -1, -1])


def apply_homography(matrix: Float64, points: Float64) -> Float64:
    """(3, 3) matrix on (..., 2) points of the plane it was fitted in.

    Points on the horizon of the middle or behind it have no image; they are put far out instead of coming back from
    the other side.
    """
    x, y = points[..., 0], points[..., 1]
    side = -1.0 if matrix[2, 2] < 0 else 1.0
    across, down, depth = (row[0] * x + row[1] * y + row[2] for row in matrix * side)
    return np.asarray(np.stack([across, down], axis=-1) / np.maximum(depth, _HORIZON)[..., None])


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
    products = _products(target, source)
    homogeneous = np.stack([*target.T, np.ones(len(target))])
    u, v = np.ascontiguousarray(source.T)
    base = homogeneous[2] if weights is None else weights
    weight = base
    matrix = np.eye(3)
    for _ in range(12):
        previous, matrix = matrix, _solution(products @ weight)
        if np.abs(matrix - previous).max() < 1e-10:
            break
        across, down, depth = matrix @ homogeneous
        front = np.maximum(depth, _HORIZON)
        residual = np.hypot(across / front - u, down / front - v)
        scale = max(2.4 * _median(residual), 1e-6)
        denominator = np.maximum(np.abs(depth), 0.1)
        weight = base / denominator**2 / (1 + (residual / scale) ** 2)
    return matrix


def _products(target: Float64, source: Float64) -> Float64:
    """(24, n) float64: what each correspondence adds to the normal equations at weight 1.

    With p = (x, y, 1) these are the six products of p p^T times 1, u, v and u^2 + v^2. All numbers of the equations are
    among them, so a round of reweighting is one product of a matrix and a vector, not a decomposition of 2n equations.
    """
    x, y = target.T
    u, v = source.T
    pairs = np.stack([x * x, x * y, x, y * y, y, np.ones_like(x)])
    return np.asarray((np.stack([np.ones_like(u), u, v, u * u + v * v])[:, None] * pairs).reshape(24, -1))


def _solution(sums: Float64) -> Float64:
    """The homography of the weighted sums of :func:`_products`; raises InvalidGrid."""
    normal, right = sums[_NORMAL_PLACES] * _NORMAL_SIGNS, sums[_RIGHT_PLACES] * _RIGHT_SIGNS
    sizes = np.linalg.eigvalsh(normal) if np.isfinite(normal).all() else np.zeros(8)
    if not sizes[0] > _LEAST_RANK * sizes[-1]:
        raise InvalidGrid("The map has no plane part: its points lie on a line.")
    return np.append(np.linalg.solve(normal, right), 1.0).reshape(3, 3)


def _median(values: Float64) -> float:
    """The median; np.median takes five times as long for a thousand numbers."""
    middle = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, middle)[middle])
    return float(np.partition(values, (middle - 1, middle))[middle - 1 : middle + 1].mean())


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
