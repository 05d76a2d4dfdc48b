"""Guides as a network speaks them: node values in the isotropic frame (see `chains`), and what is done with them.

Row guide k is given by its y at the x ``nodes``, column guide k by its x at the y ``nodes``: values (2, K, degree + 1),
rows first. With L the Lagrange basis over the anchors and M that over the nodes they define the map

    y = sum_k L_k(t) sum_n M_n(x) values[0, k, n],    x = sum_k L_k(s) sum_n M_n(y) values[1, k, n]

between target (s, t) and source (x, y). Nodes and anchors are symmetric about 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from unbend_service.domain.guides import GuideFamily, Guides, lagrange_basis
from unbend_service.domain.maps import target_lattice

Float64 = npt.NDArray[np.float64]

_NEWTON_STEPS = 6
_SHALLOWEST_SLOPE = 0.2
_FURTHEST = 2.5
_FIT_POINTS = 17
_FIT_EXTENT = 1.2
_FIT_RIDGE = 1e-6


@dataclass(frozen=True)
class GuideFrame:
    """Where the guides of a network lie: nodes (degree + 1,) and anchors (K,), float64, isotropic."""

    nodes: Float64
    anchors: Float64

    @property
    def straight(self) -> Float64:
        """Values of undistorted guides, (2, K, degree + 1)."""
        return np.broadcast_to(self.anchors[:, None], (2, len(self.anchors), len(self.nodes))).copy()

    def guides(self, values: Float64, half_width: float = 1.0, half_height: float = 1.0) -> Guides:
        """The guides of a picture of this extent, in its centred frame; exact.

        At the target heights a h of the centred anchors a the isotropic rows are one polynomial each, to which
        x = w x_centred and y = h y_centred are applied; columns likewise.

        Raises:
            InvalidGuides: values that are not finite or far outside the picture.
        """
        anchors, exponents = self.anchors, np.arange(len(self.nodes))
        rows, columns = self._coefficients(values)
        rows = lagrange_basis(anchors, anchors * half_height) @ rows * half_width**exponents / half_height
        columns = lagrange_basis(anchors, anchors * half_width) @ columns * half_height**exponents / half_width
        return Guides(GuideFamily(anchors, rows), GuideFamily(anchors, columns))

    def straightened(self, values: Float64, x: Float64, y: Float64) -> tuple[Float64, Float64]:
        """Target coordinates (s, t) of source points, each (n,), by Newton's method; held within +-_FURTHEST."""
        rows, columns = self._coefficients(values)
        return self._target(columns, y, x), self._target(rows, x, y)

    def _coefficients(self, values: Float64) -> Float64:
        """Monomial coefficients (2, K, degree + 1) of the curves."""
        powers = np.vander(self.nodes, increasing=True)
        return np.asarray(np.linalg.solve(powers, values.transpose(0, 2, 1)).transpose(0, 2, 1))

    def _target(self, curves: Float64, along: Float64, across: Float64) -> Float64:
        """Solves sum_k L_k(t) curve_k(along) = across for t."""
        monomials = np.linalg.solve(np.vander(self.anchors, increasing=True), curves)
        heights = np.vander(along, len(self.nodes), increasing=True) @ monomials.T
        target = across.copy()
        for _ in range(_NEWTON_STEPS):
            value, slope = heights[:, -1].copy(), np.zeros_like(across)
            for k in range(heights.shape[1] - 2, -1, -1):
                slope = slope * target + value
                value = value * target + heights[:, k]
            step = ((value - across) / np.maximum(slope, _SHALLOWEST_SLOPE)).clip(-0.6, 0.6)
            target = (target - step).clip(-_FURTHEST, _FURTHEST)
        return target

    def composed(self, first: Float64, second: Float64, half_width: float, half_height: float) -> Float64:
        """Values of the guides that do what `second` does (target -> straightened) and then `first` (-> source).

        The composition of two such maps is not quite one of them: a weighted least squares fit over the picture.

        Raises:
            InvalidGuides: either map folds inside the picture.
        """
        extent = np.array([half_width, half_height])
        target = target_lattice(_FIT_POINTS, _FIT_POINTS, _FIT_EXTENT).reshape(-1, 2)
        weight = np.where(np.abs(target).max(axis=1) <= 1, 1.0, 0.05)
        between = self.guides(second, half_width, half_height)(target)
        source = self.guides(first, half_width, half_height)(between) * extent
        weight = weight * (np.abs(source / extent).max(axis=1) <= 1.3)
        s, t = (target * extent).T
        x, y = source.T
        return np.stack([self._fitted(t, x, y, weight), self._fitted(s, y, x, weight)])

    def _fitted(self, anchor_at: Float64, node_at: Float64, value: Float64, weight: Float64) -> Float64:
        over_anchors, over_nodes = lagrange_basis(self.anchors, anchor_at), lagrange_basis(self.nodes, node_at)
        design = (over_anchors[:, :, None] * over_nodes[:, None, :]).reshape(len(value), -1)
        straight = self.straight[0].ravel()
        weighted = design * weight[:, None]
        normal = weighted.T @ design + _FIT_RIDGE * len(value) * np.eye(design.shape[1])
        change = np.linalg.solve(normal, weighted.T @ (value - design @ straight))
        return np.asarray((straight + change).reshape(len(self.anchors), len(self.nodes)))

    def bend(self, offset: Float64, half_width: float, half_height: float) -> float:
        """Mean displacement, isotropic, of what no infinitesimal homography explains of small value offsets."""
        right, down = _displacements(tuple(self.anchors), tuple(self.nodes), half_width, half_height)
        return mean_bend(np.stack([right @ offset[1].ravel(), down @ offset[0].ravel()]), half_width, half_height)


def bend_lattice(half_width: float, half_height: float) -> Float64:
    """(n, 2) isotropic points of the picture over which :func:`mean_bend` is a mean."""
    return target_lattice(13, 13).reshape(-1, 2) * (half_width, half_height)


def mean_bend(moved: Float64, half_width: float, half_height: float) -> float:
    """Mean length of what no infinitesimal homography explains of displacements (2, n) of `bend_lattice`."""
    tangents, project = _tangent_plane(half_width, half_height)
    flat = moved.ravel()
    return float(np.hypot(*(flat - tangents @ (project @ flat)).reshape(2, -1)).mean())


@lru_cache(maxsize=16)  # by the aspect of pictures
def _tangent_plane(half_width: float, half_height: float) -> tuple[Float64, Float64]:
    """Displacements (2 n, 8) of `bend_lattice`, x first, by the infinitesimal homographies, and what takes a
    displacement to its share of each, (8, 2 n)."""
    x, y = bend_lattice(half_width, half_height).T
    one, zero = np.ones_like(x), np.zeros_like(x)
    tangents = np.concatenate(
        [
            np.stack([one, zero, x, zero, y, zero, x * x, x * y], 1),
            np.stack([zero, one, zero, x, zero, y, x * y, y * y], 1),
        ]
    )
    normal = tangents.T @ tangents + 1e-9 * len(tangents) * np.eye(8)
    return tangents, np.linalg.solve(normal, tangents.T)


@lru_cache(maxsize=16)
def _displacements(
    anchors: tuple[float, ...], nodes: tuple[float, ...], half_width: float, half_height: float
) -> tuple[Float64, Float64]:
    """What takes offsets of column values, and of row values, each (K (degree + 1),), to displacements (n,) of
    `bend_lattice`, to the right and down."""
    over_anchors, over_nodes = np.array(anchors), np.array(nodes)
    x, y = bend_lattice(half_width, half_height).T
    right = lagrange_basis(over_anchors, x)[:, :, None] * lagrange_basis(over_nodes, y)[:, None, :]
    down = lagrange_basis(over_anchors, y)[:, :, None] * lagrange_basis(over_nodes, x)[:, None, :]
    return right.reshape(len(x), -1), down.reshape(len(x), -1)


def mirrored(values: Float64) -> Float64:
    """Values (2, K, degree + 1) of the picture mirrored left to right.

    A row guide is run through backwards; a column guide lies as far from the other side, and the order of the columns
    turns round.
    """
    return np.stack([values[0][:, ::-1], -values[1][::-1]])
