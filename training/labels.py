"""Guides as node values, batched: bases, and exact labels fitted to a true map. Isotropic frame.

K = 6 row and 6 column guides of degree 5. Row guide k is given by its y at the six x NODES, column guide k by its x at
the six y NODES: 72 numbers, rows first. (Best possible fits, mean px at 256 up to a homography, K = 4 against K = 6:
barrel 0.18, 0.02; pincushion 0.41, 0.09; Brown-Conrady 0.17, 0.02; fisheye 0.41, 0.06; wave 0.06 both.) They
describe the map through

    y = sum_k L_k(t) sum_n M_n(x) row[k, n],    x = sum_k L_k(s) sum_n M_n(y) column[k, n]

with L the Lagrange basis over ANCHORS and M that over NODES; (x, y) source, (s, t) target.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from unbend_service.domain.guides import lagrange_basis

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]

ANCHORS: Float64 = np.linspace(-0.9, 0.9, 6)
DEGREE = 5
NODES: Float64 = -0.9 * np.cos(np.pi * np.arange(DEGREE + 1) / DEGREE)
"""Chebyshev-Lobatto points of [-0.9, 0.9]."""
VALUES = 2 * len(ANCHORS) * len(NODES)
STRAIGHT: Float64 = np.tile(np.repeat(ANCHORS, len(NODES)), 2)
"""Node values of undistorted guides."""

EVAL_SIDE = 12
"""Correspondences per side at which losses are taken."""


def evaluation_points(half_extent: Float64) -> tuple[Float64, Float64]:
    """Source points spread evenly over each picture: x, y (B, EVAL_SIDE^2), for half extents (B, 2)."""
    centres = (2 * np.arange(EVAL_SIDE) + 1) / EVAL_SIDE - 1
    grid_x, grid_y = (a.ravel() for a in np.meshgrid(centres, centres))
    return half_extent[:, :1] * grid_x, half_extent[:, 1:] * grid_y


def evaluation_weights(target_x: Float64, target_y: Float64, area: Float64, half_extent: Float64) -> Float64:
    """How much each correspondence counts, (B, n): evenly over the target frame, less and less beyond it.

    area: (B, n), target area per source area, which turns an even spread over the source into one over the target.
    """
    outside = np.maximum(np.abs(target_x) / half_extent[:, :1], np.abs(target_y) / half_extent[:, 1:])
    share = np.where(outside < 1.04, 1.0, np.where(outside < 1.35, 0.07, np.where(outside < 1.7, 0.01, 0.0)))
    return np.asarray(share * np.nan_to_num(area, nan=1.0).clip(0.1, 4.0))


def fit_labels(
    source_x: Float64, source_y: Float64, target_x: Float64, target_y: Float64, weights: Float64, ridge: float = 1e-5
) -> Float64:
    """Node values (B, VALUES) by weighted linear least squares on correspondences (B, n)."""
    size, count = source_x.shape
    terms = len(ANCHORS) * len(NODES)
    straight = STRAIGHT[:terms]
    fitted = []
    for anchor_at, node_at, value in ((target_y, source_x, source_y), (target_x, source_y, source_x)):
        # Single precision halves the time, and labels need not be better than the features.
        over_anchors = lagrange_basis(ANCHORS, anchor_at.clip(-1.8, 1.8).ravel()).reshape(size, count, -1)
        over_nodes = lagrange_basis(NODES, node_at.ravel()).reshape(size, count, -1)
        over_anchors, over_nodes = over_anchors.astype(np.float32), over_nodes.astype(np.float32)
        design = (over_anchors[..., :, None] * over_nodes[..., None, :]).reshape(size, count, terms)
        weighted = design * weights.astype(np.float32)[..., None]
        normal = weighted.transpose(0, 2, 1) @ design + ridge * count * np.eye(terms)
        residual = (value - design @ straight).astype(np.float32)
        right = (weighted.transpose(0, 2, 1) @ residual[..., None])[..., 0]
        fitted.append(straight + np.linalg.solve(normal, right[..., None])[..., 0])
    return np.concatenate(fitted, 1)
