"""Guides: the curves that ought to be straight, and the backward map that they define.

Everything here is in centred coordinates: [-1, 1] to the right and down, see design section 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from unbend_service.domain.errors import InvalidGuides

Float64 = npt.NDArray[np.float64]

#: Beyond this a polynomial says nothing any more and is continued along its tangent.
TRUSTED_EXTENT = 1.25
#: Anchors of the shipped estimators: 0.05, 0.35, 0.65 and 0.95 of the way across.
DEFAULT_ANCHORS = (-0.9, -0.3, 0.3, 0.9)
_MAX_COEFFICIENT = 16.0
_MAX_COUNT = 32
_MAX_DEGREE = 15


@dataclass(frozen=True, eq=False)
class GuideFamily:
    """K guides of one direction.

    Attributes:
        anchors: (K,) float64, strictly increasing, in (-1, 1): where each guide lies once straight (target).
        coefficients: (K, degree + 1) float64: of a row guide y = c0 + c1 x + c2 x^2 ..., of a column guide
            x = c0 + c1 y + c2 y^2 ...; x and y in the source.

    Raises:
        InvalidGuides: wrong shape, not finite, anchors out of order or out of range.
    """

    anchors: Float64
    coefficients: Float64

    def __post_init__(self) -> None:
        anchors = np.array(self.anchors, dtype=np.float64)
        coefficients = np.array(self.coefficients, dtype=np.float64)
        if anchors.ndim != 1 or not 2 <= len(anchors) <= _MAX_COUNT:
            raise InvalidGuides(f"{anchors.size} guides of a direction.", allowed=f"2 to {_MAX_COUNT}")
        if coefficients.ndim != 2 or len(coefficients) != len(anchors):
            raise InvalidGuides("Each guide needs an anchor and the same number of coefficients.")
        if not 2 <= coefficients.shape[1] <= _MAX_DEGREE + 1:
            raise InvalidGuides(f"A guide of {coefficients.shape[1]} coefficients.", allowed=f"2 to {_MAX_DEGREE + 1}")
        if not (np.isfinite(anchors).all() and np.isfinite(coefficients).all()):
            raise InvalidGuides("A guide has a number that is not finite.")
        if np.abs(coefficients).max() > _MAX_COEFFICIENT:
            raise InvalidGuides(
                "A guide coefficient is too large.", allowed=f"-{_MAX_COEFFICIENT} to {_MAX_COEFFICIENT}"
            )
        if np.abs(anchors).max() >= 1 or (np.diff(anchors) < 1e-3).any():
            raise InvalidGuides("Anchors must increase and lie inside the picture.", allowed="-1 < a1 < a2 < ... < 1")
        anchors.flags.writeable = False
        coefficients.flags.writeable = False
        object.__setattr__(self, "anchors", anchors)
        object.__setattr__(self, "coefficients", coefficients)

    @classmethod
    def straight(cls, anchors: npt.ArrayLike = DEFAULT_ANCHORS, degree: int = 5) -> GuideFamily:
        """Undistorted guides: c = (anchor, 0, 0, ...)."""
        anchors = np.asarray(anchors, dtype=np.float64)
        coefficients = np.zeros((len(anchors), degree + 1))
        coefficients[:, 0] = anchors
        return cls(anchors, coefficients)

    @property
    def degree(self) -> int:
        return int(self.coefficients.shape[1] - 1)

    def at(self, position: Float64) -> Float64:
        """Coefficients of the curve that is straight at target ``position`` (n,) -> (n, degree + 1).

        Lagrange interpolation over the anchors, continued linearly outside +-TRUSTED_EXTENT.
        """
        inside = np.clip(position, -TRUSTED_EXTENT, TRUSTED_EXTENT)
        basis = lagrange_basis(self.anchors, inside)
        outside = position - inside
        if outside.any():
            basis = basis + outside[:, None] * _lagrange_slope(self.anchors, inside)
        return basis @ self.coefficients


@dataclass(frozen=True, eq=False)
class Guides:
    """Row and column guides; as a callable, the backward map target -> source that they define."""

    rows: GuideFamily
    columns: GuideFamily

    @classmethod
    def straight(cls, anchors: npt.ArrayLike = DEFAULT_ANCHORS, degree: int = 5) -> Guides:
        """Guides of an undistorted picture: their map is the identity."""
        return cls(GuideFamily.straight(anchors, degree), GuideFamily.straight(anchors, degree))

    def __call__(self, target: Float64) -> Float64:
        """Where each target point comes from.

        At target (s, t) the row curve R_t and the column curve C_s are intersected, y = R_t(x) and x = C_s(y), by
        damped Newton steps.

        Args:
            target: (..., 2) float64, (s, t) centred target coordinates, also outside [-1, 1].

        Returns:
            (..., 2) float64 (x, y), centred source coordinates.

        Raises:
            InvalidGuides: the two curves do not intersect near some point of the picture.
        """
        points = np.asarray(target, dtype=np.float64).reshape(-1, 2)
        row, column = self.rows.at(points[:, 1]), self.columns.at(points[:, 0])
        x, y = points[:, 0].copy(), points[:, 1].copy()
        for _ in range(20):
            row_y, row_slope = _polynomial(row, x)
            column_x, column_slope = _polynomial(column, y)
            residual_x, residual_y = x - column_x, y - row_y
            determinant = 1 - row_slope * column_slope
            determinant = np.where(np.abs(determinant) < 0.05, 0.05, determinant)
            step_x = (residual_x + column_slope * residual_y) / determinant
            step_y = (row_slope * residual_x + residual_y) / determinant
            size = np.maximum(np.abs(step_x), np.abs(step_y))
            damping = np.minimum(1, 0.5 / np.maximum(size, 1e-12))
            x -= damping * step_x
            y -= damping * step_y
            if size.max(initial=0) < 1e-9:
                break
        residual = np.maximum(np.abs(x - _polynomial(column, y)[0]), np.abs(y - _polynomial(row, x)[0]))
        inside = np.abs(points).max(axis=1, initial=0) <= 1
        if (residual[inside] > 1e-4).any() or not np.isfinite(residual).all():
            raise InvalidGuides("Row and column guides do not intersect everywhere in the picture.")
        return np.stack([x, y], axis=-1).reshape(np.shape(target))

    def to_dict(self) -> dict[str, Any]:
        """The ``guides`` object of the API: {rows, columns: [{anchor, coefficients}]}."""
        return {name: _family_to_list(family) for name, family in (("rows", self.rows), ("columns", self.columns))}

    @classmethod
    def from_dict(cls, value: Any) -> Guides:
        """Inverse of :meth:`to_dict`; raises InvalidGuides for anything else."""
        if not isinstance(value, dict):
            raise InvalidGuides("Guides must be an object with rows and columns.")
        return cls(_family_from_list(value.get("rows")), _family_from_list(value.get("columns")))

    @cached_property
    def is_straight(self) -> bool:
        """Whether the map is the identity to the last bit that matters (1e-9)."""
        return all(
            np.abs(family.coefficients - GuideFamily.straight(family.anchors, family.degree).coefficients).max() < 1e-9
            for family in (self.rows, self.columns)
        )


def lagrange_basis(nodes: Float64, position: Float64) -> Float64:
    """(n, K) Lagrange basis polynomials over ``nodes`` (K,) at ``position`` (n,)."""
    basis = np.ones((len(position), len(nodes)))
    for i, node in enumerate(nodes):
        for j, other in enumerate(nodes):
            if i != j:
                basis[:, i] *= (position - other) / (node - other)
    return basis


def _lagrange_slope(nodes: Float64, position: Float64) -> Float64:
    step = 1e-5
    return (lagrange_basis(nodes, position + step) - lagrange_basis(nodes, position - step)) / (2 * step)


def _polynomial(coefficients: Float64, argument: Float64) -> tuple[Float64, Float64]:
    """Value and slope of one polynomial per point (n, degree + 1) at ``argument`` (n,), by Horner's rule."""
    inside = np.clip(argument, -TRUSTED_EXTENT, TRUSTED_EXTENT)
    value = np.zeros_like(inside)
    slope = np.zeros_like(inside)
    for power in range(coefficients.shape[1] - 1, -1, -1):
        slope = slope * inside + value
        value = value * inside + coefficients[:, power]
    return value + slope * (argument - inside), slope


def _family_to_list(family: GuideFamily) -> list[dict[str, Any]]:
    pairs = zip(family.anchors, family.coefficients, strict=True)
    return [{"anchor": float(anchor), "coefficients": [float(c) for c in row]} for anchor, row in pairs]


def _family_from_list(value: Any) -> GuideFamily:
    try:
        anchors = [float(guide["anchor"]) for guide in value]
        coefficients = [[float(c) for c in guide["coefficients"]] for guide in value]
        return GuideFamily(np.array(anchors), np.array(coefficients))
    except InvalidGuides:
        raise
    except (TypeError, KeyError, ValueError, OverflowError) as error:
        raise InvalidGuides(
            "Guides must be lists of {anchor, coefficients} with the same number of coefficients each."
        ) from error
