"""Guides seen from the source: where they put points of the picture, and how far that is from another straightening.

Isotropic frame (see `chains`).
"""

from __future__ import annotations

import numpy as np

from unbend_service.domain.errors import InvalidGuides
from unbend_service.domain.guides import TRUSTED_EXTENT, GuideFamily, Guides
from unbend_service.domain.maps import Float64

PIXELS = 128.0
"""Pixels per isotropic unit of a picture whose long side has 256."""
_LATTICE = 11
_ROUNDS = 6
_SETTLED = 1e-10
_LEAST_SLOPE = 0.15
_FURTHEST = 4.0
_RIDGE = 1e-9
_SYMMETRIC = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""Where x^2, xy, x, y^2, y, 1 stand in the outer product of (x, y, 1) with itself."""
_ONE, _BY_U, _BY_V, _BY_SQUARE = (4 * _SYMMETRIC + i for i in range(4))
"""Where its products with 1, u, v and u^2 + v^2 stand among the moments of `_homographies`."""
_NONE = np.zeros((3, 3), np.int64)
_NORMAL_PLACES = np.block(
    [
        [_ONE, _NONE, _BY_U[:, :2]],
        [_NONE, _ONE, _BY_V[:, :2]],
        [_BY_U[:2], _BY_V[:2], _BY_SQUARE[:2, :2]],
    ]
)
_NORMAL_SIGNS = np.kron([[1, 0, -1], [0, 1, -1], [-1, -1, 1]], np.ones((3, 3)))[:8, :8]
_RIGHT_PLACES = np.concatenate([_BY_U[:, 2], _BY_V[:, 2], _BY_SQUARE[:2, 2]])
_RIGHT_SIGNS = np.array([1.0, 1, 1, 1, 1, 1, -1, -1])


class GuidesView:
    """The forward map, source to target, of guides, and a lattice of the picture on which it is compared.

    Attributes:
        source: (n, 2) float64, cell centres of an even lattice over the picture, isotropic.

    Raises:
        InvalidGuides: guides that put the picture nowhere.
    """

    def __init__(self, guides: Guides, half_width: float, half_height: float) -> None:
        self._extent = np.array([half_width, half_height])
        self._families = [(family, _monomials(family)) for family in (guides.columns, guides.rows)]
        centres = (2 * np.arange(_LATTICE) + 1) / _LATTICE - 1
        x, y = np.meshgrid(centres * half_width, centres * half_height)
        self.source: Float64 = np.stack([x.ravel(), y.ravel()], axis=1)
        self._target = self.straighten(self.source)
        if not np.isfinite(self._target).all() or np.abs(self._target).max() > _FURTHEST:
            raise InvalidGuides("The guides put parts of the picture nowhere.")
        self._share = self._shares()
        self._scale = np.tile(PIXELS * np.sqrt(self._share), 2)
        self._tangents, self._project = self._tangent_plane()

    def _shares(self) -> Float64:
        """(n,) by which squared target distances count, so that their mean is the squared error in source pixels over
        the frame of the target: a point that is magnified counts less, one that leaves the frame hardly at all."""
        target = self._target.reshape(_LATTICE, _LATTICE, 2)
        step = 2 * self._extent / _LATTICE
        down = np.asarray(np.gradient(target, step[1], axis=0))
        right = np.asarray(np.gradient(target, step[0], axis=1))
        area = np.abs(right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0]).clip(0.2, 5).ravel()
        reach = np.abs(self._target / self._extent).max(axis=1)
        shown = np.where(reach <= 1.06, 1.0, np.where(reach <= 1.35, 0.15, 0.02))
        return np.asarray(shown / (shown * area).mean())

    def _tangent_plane(self) -> tuple[Float64, Float64]:
        """Displacements (2 n, 8) of the target by the eight infinitesimal homographies, x first, and what takes a
        displacement to its weighted share of each, (8, 2 n)."""
        u, v = self._target.T
        one, zero = np.ones_like(u), np.zeros_like(u)
        across = np.stack([one, zero, u, zero, v, zero, u * u, u * v], axis=1)
        down = np.stack([zero, one, zero, u, zero, v, u * v, v * v], axis=1)
        tangents = np.concatenate([across, down])
        weighted = tangents * np.tile(self._share, 2)[:, None]
        normal = weighted.T @ tangents + _RIDGE * len(u) * np.eye(8)
        return tangents, np.asarray(np.linalg.solve(normal, weighted.T))

    def straighten(self, source: Float64) -> Float64:
        """Source (n, 2) -> target (n, 2), isotropic.

        The column guide through (x, y) is the s that solves x = C_s(y): a polynomial in s of as many terms as there
        are guides, taken by Newton steps; likewise t for rows.
        """
        x, y = (source / self._extent).T
        columns, rows = self._families
        return np.asarray(np.stack([_position(*columns, y, x), _position(*rows, x, y)], axis=1) * self._extent)

    def residual(self, straightened: Float64) -> Float64:
        """What is left between another straightening and that of the guides after the best homography.

        Args:
            straightened: (..., n, 2) isotropic targets of ``source``.

        Returns:
            (..., 2 n), those to the right first; the sum of its squares over n is the squared error of the backward
            map over the frame of the target, source pixels of a 256 picture.
        """
        left = self._aligned(straightened)[1] - self._target
        return np.concatenate([left[..., 0], left[..., 1]], axis=-1) * self._scale

    def residual_near(self, x: Float64, y: Float64, pose: Float64) -> Float64:
        """`residual` of targets with the axes apart, (..., n) each, ten times faster, where the best homography is
        nearly ``pose`` (3, 3): right to first order in what is left after it."""
        depth = np.maximum(x * pose[2, 0] + y * pose[2, 1] + pose[2, 2], 0.1)
        left_x = (x * pose[0, 0] + y * pose[0, 1] + pose[0, 2]) / depth - self._target[:, 0]
        left_y = (x * pose[1, 0] + y * pose[1, 1] + pose[1, 2]) / depth - self._target[:, 1]
        left = np.concatenate([left_x, left_y], axis=-1)
        left -= (left @ self._project.T) @ self._tangents.T
        return np.asarray(left * self._scale)

    def pose(self, straightened: Float64) -> Float64:
        """(3, 3) homography, isotropic, that takes (n, 2) ``straightened`` nearest to the guides' targets."""
        return np.asarray(self._aligned(straightened)[0])

    def _aligned(self, straightened: Float64) -> tuple[Float64, Float64]:
        """Homographies (..., 3, 3) by least squares, reweighted once from algebraic to geometric error, and what they
        make of ``straightened``."""
        x, y = straightened[..., 0], straightened[..., 1]
        products = np.stack([x * x, x * y, x, y * y, y, np.ones_like(x)], axis=-2)
        u, v = self._target.T
        against = np.stack([np.ones_like(u), u, v, u * u + v * v], axis=-1)
        matrix, weight = np.eye(3), np.broadcast_to(self._share, x.shape)
        for _ in range(2):
            moments = (products * weight[..., None, :]) @ against
            matrix = _homographies(moments)
            depth = x * matrix[..., 2:, 0] + y * matrix[..., 2:, 1] + 1
            weight = self._share / np.maximum(depth, 0.1) ** 2
        projected = straightened @ np.swapaxes(matrix[..., :2, :2], -1, -2) + matrix[..., None, :2, 2]
        return matrix, np.asarray(projected / np.maximum(depth, 1e-3)[..., None])


def _homographies(moments: Float64) -> Float64:
    """(..., 3, 3) from sums over points: (..., 6, 4) of (x^2, xy, x, y^2, y, 1) against (1, u, v, u^2 + v^2)."""
    flat = moments.reshape(*moments.shape[:-2], -1)
    normal = flat[..., _NORMAL_PLACES] * _NORMAL_SIGNS + _RIDGE * np.eye(8)
    right = flat[..., _RIGHT_PLACES] * _RIGHT_SIGNS
    solution = np.linalg.solve(normal, right[..., None])[..., 0]
    last = np.ones((*solution.shape[:-1], 1))
    return np.concatenate([solution, last], axis=-1).reshape(*solution.shape[:-1], 3, 3)


def _monomials(family: GuideFamily) -> Float64:
    """(K, K): values at the anchors -> coefficients of the polynomial through them, lowest power first."""
    return np.asarray(np.linalg.inv(np.vander(family.anchors, increasing=True)).T, dtype=np.float64)


def _position(family: GuideFamily, monomials: Float64, along: Float64, value: Float64) -> Float64:
    """(n,) target position of the guide through ``value`` at ``along``, centred, continued straight far outside."""
    inside = np.clip(along, -TRUSTED_EXTENT, TRUSTED_EXTENT)
    heights = np.vander(inside, family.degree + 1, increasing=True) @ family.coefficients.T
    deviation = np.ascontiguousarray(((heights - family.anchors) @ monomials).T)
    position = value.copy()
    for _ in range(_ROUNDS):
        held = np.clip(position, -TRUSTED_EXTENT, TRUSTED_EXTENT)
        offset, slope = deviation[-1].copy(), np.zeros_like(position)
        for term in deviation[-2::-1]:
            slope *= held
            slope += offset
            offset *= held
            offset += term
        error = position + offset + slope * (position - held) - value
        step = np.clip(error / np.maximum(1 + slope, _LEAST_SLOPE), -0.5, 0.5)
        position -= step
        if np.abs(step).max(initial=0) < _SETTLED:
            break
    return position
