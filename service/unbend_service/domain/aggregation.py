"""Several looks at the same lens: one set of guides from the estimates of several frames."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from unbend_service.domain.errors import InvalidGuides
from unbend_service.domain.guides import Float64, GuideFamily, Guides


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


def aggregate_guides(guides: Sequence[Guides], confidences: Sequence[float]) -> tuple[Guides, float]:
    """Guides and confidence that several estimates of one lens agree on.

    The median is taken of where the curves lie, at as many Chebyshev nodes as a curve has coefficients, and the curve
    through the medians is returned. Values at nodes and coefficients determine each other, but the coefficients of
    higher degree trade off against each other, so that a median of coefficients may lie off every curve that it was
    taken of, while a median of positions cannot. It ignores frames that are far off (motion blur, a cut to black, a
    close-up without lines) as long as they hold less than half of the confidence, and unlike the median of the maps
    it leaves guides, which can be shown, edited and sent.

    Args:
        guides: at least one; the same anchors and degree each.
        confidences: 0..1 of each; the weights.

    Returns:
        The guides and the median of the confidences, weighted equally: confident frames do not vouch for the others.

    Raises:
        InvalidGuides: none, or of different anchors or degrees.
    """
    if not guides:
        raise InvalidGuides("There are no guides to be combined.")
    weights = np.asarray(confidences, dtype=np.float64)
    rows = _median_family([one.rows for one in guides], weights)
    columns = _median_family([one.columns for one in guides], weights)
    return Guides(rows, columns), float(np.median(weights))


def _median_family(families: Sequence[GuideFamily], weights: Float64) -> GuideFamily:
    first = families[0]
    for family in families:
        if family.coefficients.shape != first.coefficients.shape or not np.allclose(family.anchors, first.anchors):
            raise InvalidGuides("Guides with different anchors or degrees cannot be combined.")
    if len(families) == 1:
        return first
    count = first.degree + 1
    nodes = np.cos((2 * np.arange(count) + 1) * np.pi / (2 * count))
    powers = np.vander(nodes, count, increasing=True)
    positions = np.stack([family.coefficients @ powers.T for family in families])
    median = weighted_median(positions, weights)
    return GuideFamily(first.anchors, np.linalg.solve(powers, median.T).T)
