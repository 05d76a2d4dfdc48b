"""How wrong a backward map is, and how far a corrected picture is from the original.

End-point errors (EPE) are in pixels of a picture whose long side is 256, over the part of the target that the
distorted picture shows: of everything (`all`), and up to the best target-side homography, which asks only that
straight lines be straight.
"""

from __future__ import annotations

import cv2
import numpy as np

from unbend_service.domain.grid import Grid
from unbend_service.domain.maps import BackwardMap
from unbend_service.evaluation.cases import Bytes, Float64

_STEPS = 15
_LARGEST_DAMPING = 1e5
_SSIM_WINDOW_PX = 7
_SSIM_K1, _SSIM_K2 = 0.01, 0.03


def map_errors(backward: BackwardMap, target: Float64, truth: Float64, half_px: Float64) -> tuple[float, float]:
    """Mean EPE of a backward map, px: of everything, and after the best homography of the target.

    Args:
        backward: target -> source, centred. target, truth: (n, 2) centred correspondences.
        half_px: (2,) pixels to a centred unit across and down.
    """
    missed = (backward(target) - truth) * half_px
    return float(np.hypot(*missed.T).mean()), _aligned_error(backward, target, truth, half_px)


def as_rendered(grid: Grid) -> BackwardMap:
    """The grid as the public evaluation reads it: bilinear inside the frame, moved along with its edge outside."""

    lattice = grid.continued(1.0)

    def backward(target: Float64) -> Float64:
        inside = np.clip(target, -1, 1)
        return np.asarray(lattice(inside) + (target - inside))

    return backward


def _aligned_error(backward: BackwardMap, target: Float64, truth: Float64, half_px: Float64) -> float:
    """Mean error after Gauss-Newton (Levenberg) on the 8 numbers of S in |backward(S(target)) - truth|^2."""
    parameters, damping = np.zeros(8), 1e-6
    residual, jacobian = _residual(backward, target, truth, half_px, parameters)
    for _ in range(_STEPS):
        normal, right = jacobian.T @ jacobian, jacobian.T @ residual.ravel()
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-9), -right)
        tried, tried_jacobian = _residual(backward, target, truth, half_px, parameters + step)
        gained = (residual**2).sum() - (tried**2).sum()
        if gained > 0:
            settled = gained < 1e-5 * (residual**2).sum()
            parameters, residual, jacobian, damping = parameters + step, tried, tried_jacobian, max(damping / 5, 1e-9)
            if settled:
                break
        else:
            damping *= 10
            if damping > _LARGEST_DAMPING:
                break
    return float(np.hypot(*residual.T).mean())


def _residual(
    backward: BackwardMap, target: Float64, truth: Float64, half_px: Float64, p: Float64
) -> tuple[Float64, Float64]:
    """backward(S(target)) - truth in px, (n, 2), and its derivative by the parameters, (2 n, 8), x, y interleaved."""
    s, t = target.T
    matrix = np.array([[1 + p[0], p[1], p[2]], [p[3], 1 + p[4], p[5]], [p[6], p[7], 1.0]])
    projected = np.stack([s, t, np.ones_like(s)], 1) @ matrix.T
    depth = np.maximum(projected[:, 2:], 0.05)
    moved = (projected[:, :2] / depth).clip(-3, 3)
    step = 1e-4
    here = backward(moved)
    by_s = (backward(moved + np.array([step, 0])) - here) / step * half_px
    by_t = (backward(moved + np.array([0, step])) - here) / step * half_px
    zero, one = np.zeros_like(s), np.ones_like(s)
    of_s = np.stack([s, t, one, zero, zero, zero, -moved[:, 0] * s, -moved[:, 0] * t], 1) / depth
    of_t = np.stack([zero, zero, zero, s, t, one, -moved[:, 1] * s, -moved[:, 1] * t], 1) / depth
    jacobian = by_s[:, :, None] * of_s[:, None, :] + by_t[:, :, None] * of_t[:, None, :]
    return (here - truth) * half_px, jacobian.reshape(-1, 8)


def displacement_px(backward: BackwardMap, target: Float64, half_px: Float64) -> float:
    """Mean distance that a map moves points, px."""
    return float(np.hypot(*((backward(target) - target) * half_px).T).mean())


def ssim_and_mse(found: Bytes, original: Bytes, shown: np.typing.NDArray[np.bool_]) -> tuple[float, float]:
    """Structural similarity (Wang et al. 2004, windows of 7 x 7 px evenly weighted) and mean squared error, over the
    pixels `shown`; grey uint8 pictures of one size."""
    a, b = found.astype(np.float64), original.astype(np.float64)
    size = (_SSIM_WINDOW_PX, _SSIM_WINDOW_PX)

    def mean(values: Float64) -> Float64:
        return np.asarray(cv2.blur(values, size, borderType=cv2.BORDER_REFLECT), np.float64)

    unbiased = _SSIM_WINDOW_PX**2 / (_SSIM_WINDOW_PX**2 - 1)
    mean_a, mean_b = mean(a), mean(b)
    variance_a, variance_b = (mean(a * a) - mean_a**2) * unbiased, (mean(b * b) - mean_b**2) * unbiased
    covariance = (mean(a * b) - mean_a * mean_b) * unbiased
    c1, c2 = (_SSIM_K1 * 255) ** 2, (_SSIM_K2 * 255) ** 2
    similarity = ((2 * mean_a * mean_b + c1) * (2 * covariance + c2)) / (
        (mean_a**2 + mean_b**2 + c1) * (variance_a + variance_b + c2)
    )
    return float(similarity[shown].mean()), float(((a - b) ** 2)[shown].mean())
