"""Fitting guides to a map that is known by its correspondences."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from unbend_service.domain.errors import InvalidGuides
from unbend_service.domain.guides import DEFAULT_ANCHORS, GuideFamily, Guides, anchor_basis, power_basis
from unbend_service.domain.maps import BackwardMap, Float64, target_lattice

#: Pull towards straight guides, per correspondence: decides only what the correspondences leave open.
RIDGE = 1e-7
#: A source point is still taken along this far outside the picture, so that guides are held at its very edge.
_MARGIN = 0.05


def fit_guides(
    source: npt.ArrayLike,
    target: npt.ArrayLike,
    anchors: npt.ArrayLike = DEFAULT_ANCHORS,
    degree: int = 5,
    weights: npt.ArrayLike | None = None,
    *,
    polish: int = 3,
) -> Guides:
    """Guides whose map takes each target point to its source point, in the least squares sense.

    A source point (x, y) of target (s, t) lies on the row curve of t and on the column curve of s,

        y = sum_k L_k(t) p_k(x),    x = sum_k L_k(s) q_k(y),

    with L_k the Lagrange polynomials over the anchors: linear in the coefficients of p and q. That residual runs along
    the axes; Gauss-Newton steps on the distance between the intersection and the source point follow (Levenberg's
    damping, so that no step makes it worse).

    Args:
        source: (n, 2) centred source points.
        target: (n, 2) centred target points, n >= 1.
        anchors: (K,) where the guides lie once straight, target.
        degree: of the guides, 1 or more.
        weights: (n,) >= 0; equal weights if left out.
        polish: most Gauss-Newton steps; 0 leaves the linear solution.

    Raises:
        InvalidGuides: arrays that do not match, are not finite, or ask for guides out of range.
    """
    source, target = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    weight = np.ones(len(source)) if weights is None else np.asarray(weights, dtype=np.float64)
    if source.ndim != 2 or source.shape[1] != 2 or source.shape != target.shape or weight.shape != (len(source),):
        raise InvalidGuides("Guides are fitted to (n, 2) source points and as many target points and weights.")
    if not (np.isfinite(source).all() and np.isfinite(target).all() and np.isfinite(weight).all()):
        raise InvalidGuides("A correspondence has a number that is not finite.")
    if (weight < 0).any() or not weight.any():
        raise InvalidGuides("Weights must not be negative, nor all be 0.")
    straight = Guides.straight(anchors, degree)
    weight = weight / weight.sum()
    rows = _fit_family(straight.rows, target[:, 1], source[:, 0], source[:, 1], weight)
    columns = _fit_family(straight.columns, target[:, 0], source[:, 1], source[:, 0], weight)
    guides = Guides(rows, columns)
    return _polished(guides, source, target, weight, polish) if polish else guides


def guides_from_map(
    backward: BackwardMap,
    anchors: npt.ArrayLike = DEFAULT_ANCHORS,
    degree: int = 5,
    *,
    points: int = 41,
    polish: int = 3,
) -> Guides:
    """Guides that follow ``backward`` over the visible part of the target frame.

    Args:
        backward: target -> source, centred; NaN where a target point has no source.
        points: rows and columns of the target lattice that is looked at.

    Raises:
        InvalidGuides: nothing of the source is visible in the target frame, or see :func:`fit_guides`.
    """
    target = target_lattice(points, points).reshape(-1, 2)
    source = backward(target)
    with np.errstate(invalid="ignore"):
        visible = (np.abs(source) <= 1 + _MARGIN).all(axis=1)
    if not visible.any():
        raise InvalidGuides("The map shows nothing of the source.")
    return fit_guides(source[visible], target[visible], anchors, degree, polish=polish)


def _fit_family(straight: GuideFamily, across: Float64, along: Float64, value: Float64, weight: Float64) -> GuideFamily:
    """Least squares for one direction; the ridge acts on the guides' heights, not on raw coefficients."""
    degree = straight.degree
    design = anchor_basis(straight.anchors, across)[:, :, None] * power_basis(along, degree)[:, None, :]
    design = design.reshape(len(across), -1)
    nodes = np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    heights = np.kron(np.eye(len(straight.anchors)), np.vander(nodes, increasing=True))
    root = np.sqrt(weight)
    left = np.concatenate([design * root[:, None], np.sqrt(RIDGE) * heights])
    right = np.concatenate([(value - across) * root, np.zeros(len(heights))])
    deviation = np.linalg.lstsq(left, right, rcond=None)[0].reshape(straight.coefficients.shape)
    return GuideFamily(straight.anchors, straight.coefficients + deviation)


def _polished(guides: Guides, source: Float64, target: Float64, weight: Float64, steps: int) -> Guides:
    root = np.sqrt(np.stack([weight, weight], axis=-1))
    split = guides.rows.coefficients.size

    def residual(candidate: Guides) -> Float64:
        return np.asarray((candidate(target) - source) * root)

    try:
        error = residual(guides)
    except InvalidGuides:
        return guides
    damping = 1e-6
    for _ in range(steps):
        jacobian = _jacobian(guides, target) * root[..., None]
        jacobian = jacobian.reshape(-1, jacobian.shape[-1])
        normal = jacobian.T @ jacobian + RIDGE * np.eye(jacobian.shape[1])
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), -jacobian.T @ error.ravel())
        try:
            better = Guides(
                GuideFamily(
                    guides.rows.anchors, guides.rows.coefficients + step[:split].reshape(guides.rows.coefficients.shape)
                ),
                GuideFamily(
                    guides.columns.anchors,
                    guides.columns.coefficients + step[split:].reshape(guides.columns.coefficients.shape),
                ),
            )
            lower = residual(better)
        except InvalidGuides:
            damping *= 100
            continue
        if (lower**2).sum() >= (error**2).sum():
            damping *= 100
            continue
        guides, error, damping = better, lower, damping / 10
    return guides


def _jacobian(guides: Guides, target: Float64) -> Float64:
    """(n, 2, parameters) derivative of the intersection, from dy = R' dx + dR and dx = C' dy + dC."""
    found = guides(target)
    row_curve, column_curve = guides.rows.at(target[:, 1]), guides.columns.at(target[:, 0])
    row_slope = _slope(row_curve, found[:, 0])
    column_slope = _slope(column_curve, found[:, 1])
    determinant = np.maximum(1 - row_slope * column_slope, 0.02)
    row = anchor_basis(guides.rows.anchors, target[:, 1])[:, :, None]
    row = (row * power_basis(found[:, 0], guides.rows.degree)[:, None, :]).reshape(len(target), -1)
    column = anchor_basis(guides.columns.anchors, target[:, 0])[:, :, None]
    column = (column * power_basis(found[:, 1], guides.columns.degree)[:, None, :]).reshape(len(target), -1)
    dx = np.concatenate([column_slope[:, None] * row, column], axis=1)
    dy = np.concatenate([row, row_slope[:, None] * column], axis=1)
    return np.stack([dx, dy], axis=1) / determinant[:, None, None]


def _slope(curves: Float64, argument: Float64) -> Float64:
    degree = curves.shape[1] - 1
    powers = power_basis(argument, max(degree - 1, 1))[:, :degree]
    return np.asarray((curves[:, 1:] * np.arange(1, degree + 1) * powers).sum(axis=1))
