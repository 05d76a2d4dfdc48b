"""Several looks at the same lens: one set of guides from the estimates of several pictures.

The lens is the same in every picture, the pose is not. So each estimate is split into its plane part and the rest (see
`homography`), and what the rests say of the lens adds up: a mean weighted by the inverse square of the error that each
expects of itself, without those that are far from the weighted median of all. Poses are combined by their median.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from unbend_service.domain.errors import InvalidGrid, InvalidGuides
from unbend_service.domain.fitting import fit_guides
from unbend_service.domain.guides import Float64, Guides
from unbend_service.domain.homography import apply_homography, plane_part
from unbend_service.domain.maps import target_lattice

_LATTICE = 25
_EXTENT = 1.05
#: Errors in half picture widths: px at 256, over 128.
_LEAST_ERROR = 0.15 / 128
_OUTLIER = 2.5
#: Share of the error that pictures of one camera have in common, and that no number of them removes.
_COMMON_SHARE = 0.3
_MOST_LOG_ODDS = 12.0


@dataclass(frozen=True, slots=True)
class Look:
    """One estimate of the lens.

    Attributes:
        guides: centred.
        confidence: 0..1.
        expected_error: of the nonlinear part, half picture widths; None if the estimator has no say.
    """

    guides: Guides
    confidence: float
    expected_error: float | None = None

    @property
    def error(self) -> float:
        """The error to reckon with, half picture widths: without a say, 1 to 4 px of 256 by the confidence."""
        if self.expected_error is None:
            return (1 + 3 * (1 - self.confidence)) / 128
        return max(self.expected_error, _LEAST_ERROR)


@dataclass(frozen=True, slots=True)
class Fused:
    """What several looks say together.

    Attributes:
        guides: centred. confidence: 0..1. expected_error: of the nonlinear part, half picture widths.
        agreeing: how many of the looks were not far off.
    """

    guides: Guides
    confidence: float
    expected_error: float
    agreeing: int


def weighted_median(values: Float64, weights: Float64) -> Float64:
    """Weighted median along the first axis.

    Args:
        values: (n, ...) float64, n >= 1.
        weights: (n,) float64 >= 0; all zero counts as all equal.

    Returns:
        (...) float64: for each component the value that half of the weight lies on either side of; where the weight
        splits exactly in two, the mean of the two values beside the split.
    """
    weights = np.asarray(weights, dtype=np.float64)
    if not weights.any():
        weights = np.ones_like(weights)
    order = np.argsort(values, axis=0, kind="stable")
    ordered = np.take_along_axis(values, order, axis=0)
    cumulative = np.cumsum(weights[order], axis=0)
    half = cumulative[-1] / 2
    tolerance = 1e-12 * cumulative[-1]
    lower = np.argmax(cumulative >= half - tolerance, axis=0)
    upper = np.argmax(cumulative > half + tolerance, axis=0)
    low = np.take_along_axis(ordered, lower[None], axis=0)[0]
    high = np.take_along_axis(ordered, upper[None], axis=0)[0]
    return np.asarray((low + high) / 2)


def fuse(looks: Sequence[Look]) -> Fused:
    """The lens that several looks show, nearer to the truth than any of them.

    Args:
        looks: at least one; guides of any number and degree.

    Returns:
        The guides of the combined lens and pose, as many and of the degree of the finest. The log odds of the
        confidence are the weighted mean of those that agree, plus log(sqrt(n)). A single look comes back as it is.

    Raises:
        InvalidGuides: no look, or none whose guides intersect.
    """
    if not looks:
        raise InvalidGuides("There are no guides to be combined.")
    if len(looks) == 1:
        return Fused(looks[0].guides, looks[0].confidence, looks[0].error, 1)
    target = target_lattice(_LATTICE, _LATTICE, _EXTENT).reshape(-1, 2)
    usable, lenses, poses = _parts(looks, target)
    errors = np.array([look.error for look in usable])
    weights = 1 / errors**2
    median = weighted_median(lenses, weights)
    shown = (np.abs(median) <= _EXTENT).all(axis=1)
    away = np.sqrt(((lenses - median)[:, shown] ** 2).sum(-1).mean(-1))
    agreeing = away <= _OUTLIER * max(float(np.median(away)), float(np.median(errors)))
    share = weights * agreeing / (weights * agreeing).sum()
    lens = np.tensordot(share, lenses, axes=1)
    pose = weighted_median(poses[agreeing], weights[agreeing])
    alone = 1 / np.sqrt(weights[agreeing].sum())
    count = int(agreeing.sum())
    scatter = np.sqrt(share @ away**2 / count)
    common = _COMMON_SHARE * float(share @ errors)
    confidence = np.array([look.confidence for look in usable])[agreeing]
    return Fused(
        _guides(lens, pose, target, [look.guides for look in usable]),
        _combined(confidence, share[agreeing], count),
        float(np.hypot(max(alone, scatter), common)),
        count,
    )


def _parts(looks: Sequence[Look], target: Float64) -> tuple[list[Look], Float64, Float64]:
    """Of the looks whose guides intersect: the maps without their plane parts at ``target`` (n, lattice, 2), and the
    plane parts (n, 3, 3)."""
    usable, lenses, poses = [], [], []
    for look in looks:
        try:
            pose = plane_part(look.guides)
            lens = look.guides(apply_homography(_inverse(pose), target))
        except (InvalidGuides, InvalidGrid, np.linalg.LinAlgError):
            continue
        usable.append(look)
        lenses.append(lens.clip(-2, 2))
        poses.append(pose / pose[2, 2])
    if not usable:
        raise InvalidGuides("None of the guides to be combined intersect.")
    return usable, np.stack(lenses), np.stack(poses)


def _guides(lens: Float64, pose: Float64, target: Float64, like: Sequence[Guides]) -> Guides:
    """Guides of the map that applies ``pose``, then the lens (n, 2) known at ``target``."""
    finest = max(like, key=lambda guides: (len(guides.rows.anchors), guides.rows.degree))
    anchors, degree = finest.rows.anchors, max(guides.rows.degree for guides in like)
    # The lattice has a value for every target of the lens; where the pose puts that target is known exactly.
    shown = (np.abs(lens) <= _EXTENT).all(axis=1)
    before = apply_homography(_inverse(pose), target)
    near = shown & (np.abs(before) <= 1.3).all(axis=1)
    return fit_guides(lens[near], before[near], anchors, degree)


def _inverse(matrix: Float64) -> Float64:
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def _combined(confidence: Float64, share: Float64, count: int) -> float:
    bounded = confidence.clip(1e-5, 1 - 1e-5)
    log_odds = float(share @ np.log(bounded / (1 - bounded)) + 0.5 * np.log(count))
    return float(1 / (1 + np.exp(-np.clip(log_odds, -_MOST_LOG_ODDS, _MOST_LOG_ODDS))))
