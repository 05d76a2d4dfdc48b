"""The division lens with a free centre, four numbers, and its guides. Isotropic frame (see `chains`).

    u = c + (x - c) / (1 + l1 r^2 + l2 r^4),    r = |x - c|

takes a source point x to where it lies once straight (Fitzgibbon, "Simultaneous linear estimation of multiple view
geometry and lens distortion", 2001, with a second term). Parameters are rows (l1, l2, cx, cy); l1 < 0 is a barrel.
One term is within a tenth of a pixel of most mild lenses, two follow a fisheye of 120 degrees.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from unbend_service.adapters.estimators.isotropic_guides import bend_lattice, mean_bend
from unbend_service.domain.guides import GuideFamily, Guides, anchor_basis, power_basis
from unbend_service.domain.homography import apply_homography
from unbend_service.domain.maps import Float64, target_lattice

IDENTITY: Float64 = np.zeros(4)
ANCHORS: Float64 = np.linspace(-0.9, 0.9, 8)
"""Of the guides of a lens: four would cost it 0.4 px on average, six 0.05, eight nothing (strong lenses, 256 px)."""
_DEGREE = 5
_LATTICE = 25
_MARGIN = 1.12
"""How far into the surroundings of the picture, centred source frame, guides are held to the lens."""
_RIDGE = 1e-9
_REACH = 1.6
"""Targets further out, centred frame, do not take part in the fit."""
_LEAST_DENOMINATOR = 0.1
_LEAST_GROWTH = 0.05
_FURTHEST_CENTRE = 0.4
_TRUSTED_RADIUS = 1.5
_SQUARES: Float64 = np.linspace(0, _TRUSTED_RADIUS, 24) ** 2
"""Of radii up to just past the corner of a square picture."""


def straighten(parameters: Float64, source: Float64) -> Float64:
    """Source (n, 2) -> target (..., n, 2), isotropic, of each lens in ``parameters`` (..., 4)."""
    return np.stack(straighten_axes(parameters, source[:, 0], source[:, 1]), axis=-1)


def straighten_axes(parameters: Float64, x: Float64, y: Float64) -> tuple[Float64, Float64]:
    """`straighten` with the axes apart, which is twice as fast: (n,) each -> (..., n) each."""
    first, second, centre_x, centre_y = (parameters[..., i, None] for i in range(4))
    across, down = x - centre_x, y - centre_y
    square = across * across + down * down
    denominator = 1 + square * (first + square * second)
    np.maximum(denominator, _LEAST_DENOMINATOR, out=denominator)
    return centre_x + across / denominator, centre_y + down / denominator


def is_lens(parameters: Float64) -> npt.NDArray[np.bool_]:
    """(...,) whether each lens in ``parameters`` (..., 4) keeps growing with the radius all over the picture."""
    first, second = parameters[..., :1], parameters[..., 1:2]
    denominator = 1 + _SQUARES * (first + _SQUARES * second)
    growth = 1 - _SQUARES * (first + 3 * _SQUARES * second)
    within = (denominator > _LEAST_DENOMINATOR) & (growth > _LEAST_GROWTH)
    return np.asarray(within.all(-1) & (np.abs(parameters[..., 2:]) < _FURTHEST_CENTRE).all(-1))


def displacement_of_lens(parameters: Float64, half_width: float, half_height: float) -> float:
    """Mean displacement, isotropic, of what no infinitesimal homography explains of the lens (4,)."""
    points = bend_lattice(half_width, half_height)
    return mean_bend((_continued(parameters, points) - points).T, half_width, half_height)


def guides_of_lens(parameters: Float64, pose: Float64, half_width: float, half_height: float) -> Guides:
    """Guides, centred frame, of the backward map that undoes the lens (4,) and then applies ``pose``.

    Args:
        pose: (3, 3) homography, isotropic frame, of the straightened picture; the target frame is its result.
        half_width, half_height: of the picture in the isotropic frame.

    Raises:
        InvalidGuides: the lens or the pose leave nothing to fit guides to.
    """
    extent = np.array([half_width, half_height])
    source = target_lattice(_LATTICE, _LATTICE, _MARGIN).reshape(-1, 2)
    target = apply_homography(pose, _continued(parameters, source * extent)) / extent
    reach = np.abs(target).max(axis=1)
    # A little weight beyond the frame and the picture, so that guides go on smoothly where they are seldom seen.
    shown = (np.abs(source) <= 1.02).all(axis=1) & (reach <= 1.1)
    weights = np.where(shown, 1.0, np.where(reach <= _REACH, 0.05, 0.0))
    target = target.clip(-_REACH, _REACH)
    return Guides(
        _fitted(target[:, 1], source[:, 0], source[:, 1], weights),
        _fitted(target[:, 0], source[:, 1], source[:, 0], weights),
    )


def _continued(parameters: Float64, source: Float64) -> Float64:
    """`straighten` of one lens (4,), continued at constant slope beyond the radius up to which it is a lens."""
    offset = source - parameters[2:]
    radius = np.hypot(*offset.T)
    inside = np.minimum(radius, _TRUSTED_RADIUS)
    square = inside**2
    denominator = np.maximum(1 + square * (parameters[0] + square * parameters[1]), _LEAST_DENOMINATOR)
    slope = (1 - square * (parameters[0] + 3 * square * parameters[1])) / denominator**2
    straightened = inside / denominator + (radius - inside) * slope
    return np.asarray(parameters[2:] + offset * (straightened / np.maximum(radius, 1e-9))[:, None])


def _fitted(across: Float64, along: Float64, value: Float64, weights: Float64) -> GuideFamily:
    """One direction, as `domain.fitting` does it, by normal equations: tenfold faster, and a lens is smooth enough."""
    straight = GuideFamily.straight(ANCHORS, _DEGREE)
    basis = anchor_basis(ANCHORS, across)[:, :, None] * power_basis(along, _DEGREE)[:, None, :]
    size = straight.coefficients.size
    # Row by row of the lattice, as small products: BLAS would start threads for one large one, and wait for them.
    basis = basis.reshape(_LATTICE, _LATTICE, size)
    weighted = np.swapaxes(basis * weights.reshape(_LATTICE, _LATTICE, 1), 1, 2)
    normal = (weighted @ basis).sum(0) + _RIDGE * weights.sum() * np.eye(size)
    right = (weighted @ (value - across).reshape(_LATTICE, _LATTICE, 1)).sum(0)[:, 0]
    deviation = np.linalg.solve(normal, right)
    return GuideFamily(ANCHORS, straight.coefficients + deviation.reshape(straight.coefficients.shape))
