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
#: Source points are not put further out than this: it is far outside every picture.
MAX_REACH = 8.0
#: 1 - R' C' of two curves that cross at a useful angle; 1 at right angles to the axes, 0 where they touch.
_LEAST_CROSSING = 0.02
#: Target points without a source go so much further out than the last that has one, or a cell between them may fold.
_CLEARANCE = 1.25
_MAX_COEFFICIENT = 16.0
_MAX_COUNT = 16  # evenly spaced anchors beyond that make the interpolation between them ill-conditioned
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

        Lagrange interpolation over the anchors, continued linearly outside +-TRUSTED_EXTENT. What is interpolated is
        the deviation from straight guides, so that straight ones stay straight to the last bit.
        """
        return np.ascontiguousarray(self.curves(position).T)

    def curves(self, position: Float64) -> Float64:
        """:meth:`at` the other way round, (degree + 1, n): a coefficient of all curves lies together."""
        deviation = self.coefficients.copy()
        deviation[:, 0] -= self.anchors
        curves = deviation.T @ _anchor_shares(self.anchors, position)
        curves[0] += position
        return np.asarray(curves)


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
        damped Newton steps. A target point beyond the last place where they meet (the corners of a picture that was
        bent hard into a pincushion: no source point belongs there) is put further out along its ray from the middle,
        where it shows nothing. Points far out are held at MAX_REACH.

        Args:
            target: (..., 2) float64, (s, t) centred target coordinates, also outside [-1, 1].

        Returns:
            (..., 2) float64 (x, y), centred source coordinates, all finite.

        Raises:
            InvalidGuides: the curves stop to intersect before the edge of the source is reached.
        """
        points = np.asarray(target, dtype=np.float64).reshape(-1, 2)
        source, met = self._intersect(points)
        if not met.all():
            source[~met] = self._beyond(points[~met])
        reach = np.abs(source).max(axis=1, initial=0, keepdims=True)
        source *= np.minimum(1, MAX_REACH / np.maximum(reach, MAX_REACH))
        return source.reshape(np.shape(target))

    def _intersect(self, points: Float64, steps: int = 24) -> tuple[Float64, npt.NDArray[np.bool_]]:
        """(n, 2) source points of (n, 2) target points, and (n,) whether the curves do meet there.

        Where they touch instead of crossing the map folds; what Newton finds behind that is another branch.
        """
        x, y = points[:, 0].copy(), points[:, 1].copy()
        row, column = self.rows.curves(y), self.columns.curves(x)
        for _ in range(steps):
            row_y, row_slope = _polynomial(row, x)
            column_x, column_slope = _polynomial(column, y)
            residual_x, residual_y = x - column_x, y - row_y
            determinant = 1 - row_slope * column_slope
            met = (np.abs(residual_x) + np.abs(residual_y) < 1e-7) & (determinant > _LEAST_CROSSING)
            if met.all():
                break
            determinant = np.where(np.abs(determinant) < 0.05, 0.05, determinant)
            step_x = (residual_x + column_slope * residual_y) / determinant
            step_y = (row_slope * residual_x + residual_y) / determinant
            damping = np.minimum(1, 0.5 / np.maximum(np.maximum(np.abs(step_x), np.abs(step_y)), 1e-12))
            x -= damping * step_x
            y -= damping * step_y
        return np.stack([x, y], axis=-1), met

    def _beyond(self, points: Float64) -> Float64:
        """Source points, outside the picture, for (n, 2) target points at which the curves do not meet.

        On the ray from the middle the last point where they meet is found by bisection; from there, and a
        little further out, the ray goes on in the direction and at the pace it had.
        """
        low, high = np.zeros(len(points)), np.ones(len(points))
        last, met = self._intersect(np.zeros((1, 2)))
        last, met = np.repeat(last, len(points), axis=0), np.repeat(met, len(points))
        for _ in range(16):
            share = (low + high) / 2
            found, met_here = self._intersect(points * share[:, None], 10)
            low, high = np.where(met_here, share, low), np.where(met_here, high, share)
            last = np.where(met_here[:, None], found, last)
            met |= met_here
        inside = (np.abs(last) < 1).all(axis=1) & (np.abs(points) <= 1).all(axis=1)
        if not met.all() or inside.any():
            raise InvalidGuides("Row and column guides do not intersect everywhere in the picture.")
        before, _ = self._intersect(points * (0.9 * low)[:, None])
        pace = (last - before) / np.maximum(0.1 * low, 1e-9)[:, None]
        pace *= np.minimum(1, 2 / np.maximum(np.hypot(*pace.T), 1e-9))[:, None]  # near a fold it has no bound
        return np.asarray(_CLEARANCE * last + pace * (1 - low)[:, None])

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
    return np.ascontiguousarray(_lagrange_shares(nodes, position).T)


def _lagrange_shares(nodes: Float64, position: Float64) -> Float64:
    """`lagrange_basis` the other way round, (K, n): a third of the time, as numpy runs along n."""
    apart = position - nodes[:, None]
    shares, above = np.ones_like(apart), np.ones_like(position)
    for k in range(1, len(nodes)):
        np.multiply(shares[k - 1], apart[k - 1], out=shares[k])
    for k in range(len(nodes) - 2, -1, -1):
        above *= apart[k + 1]
        shares[k] *= above
    between = nodes[:, None] - nodes
    np.fill_diagonal(between, 1.0)
    shares /= between.prod(axis=1)[:, None]
    return shares


def anchor_basis(anchors: Float64, position: Float64) -> Float64:
    """(n, K) share of each guide in the curve at target ``position`` (n,), linear outside +-TRUSTED_EXTENT."""
    return np.ascontiguousarray(_anchor_shares(anchors, position).T)


def _anchor_shares(anchors: Float64, position: Float64) -> Float64:
    """`anchor_basis` the other way round, (K, n)."""
    inside = np.clip(position, -TRUSTED_EXTENT, TRUSTED_EXTENT)
    shares = _lagrange_shares(anchors, inside)
    outside = np.flatnonzero(position != inside)
    if len(outside):
        step, held = 1e-5, inside[outside]
        slope = (_lagrange_shares(anchors, held + step) - _lagrange_shares(anchors, held - step)) / (2 * step)
        shares[:, outside] += (position[outside] - held) * slope
    return shares


def power_basis(argument: Float64, degree: int) -> Float64:
    """(n, degree + 1) powers of the source coordinate ``argument`` (n,), linear outside +-TRUSTED_EXTENT."""
    inside = np.clip(argument, -TRUSTED_EXTENT, TRUSTED_EXTENT)
    powers = np.vander(inside, degree + 1, increasing=True)
    powers[:, 1:] += (argument - inside)[:, None] * np.arange(1, degree + 1) * powers[:, :-1]
    return powers


def _polynomial(coefficients: Float64, argument: Float64) -> tuple[Float64, Float64]:
    """Value and slope of one polynomial per point (degree + 1, n) at ``argument`` (n,), by Horner's rule."""
    inside = np.clip(argument, -TRUSTED_EXTENT, TRUSTED_EXTENT)
    value = np.zeros_like(inside)
    slope = np.zeros_like(inside)
    for coefficient in coefficients[::-1]:
        slope *= inside
        slope += value
        value *= inside
        value += coefficient
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
