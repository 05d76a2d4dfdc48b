"""Peers for the tables of the evaluation: methods without a network, run on the same pictures.

The **classical plumb-line** (Brown 1971; Devernay and Faugeras, "Straight lines have to be straight", 2001): one
division parameter about the picture's centre, the one under which the edge chains are straightest, by a robust cost.
No prior, no network and no way to say no: superb where there are lines, lost where there are not.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from unbend_service.adapters.estimators.chains import EdgeChains, extract, fit_long_side
from unbend_service.adapters.estimators.plumbline import Plumbline
from unbend_service.adapters.estimators.radial_family import guides_of_lens, is_lens, straighten
from unbend_service.domain.guides import Guides

Float64 = npt.NDArray[np.float64]

SEARCHED_LONG_SIDE_PX = 384
FEWEST_CHAINS = 3
NOISE_PX = 0.6
"""Residual at which a chain counts half as bent."""
_RANGE = (-0.25, 0.42)
_COARSE, _FINE = 57, 33
_ORDERS = np.array([2, 3, 4])


class PlumblinePeer:
    """One radial parameter from the chains alone."""

    def examine(self, grey: npt.NDArray[np.uint8]) -> Guides:
        """Guides, centred frame, of a grey picture, uint8 (height, width); straight ones where there are no chains."""
        chains = extract(fit_long_side(grey, SEARCHED_LONG_SIDE_PX))
        lens = np.array([straightest_division(chains), 0.0, 0.0, 0.0])
        return guides_of_lens(lens, np.eye(3), chains.half_width, chains.half_height)


def straightest_division(chains: EdgeChains) -> float:
    """l1 of the centred division lens (isotropic frame) under which the chains are straightest; 0 without chains.

    The cost of a chain of length L and residual r (rms, px) is L r^2 / (r^2 + NOISE_PX^2): Geman and McClure's.
    """
    plumbline = Plumbline(chains)
    if plumbline.count < FEWEST_CHAINS:
        return 0.0
    coarse = np.linspace(*_RANGE, _COARSE)
    best = coarse[np.argmin(_costs(plumbline, coarse))]
    step = coarse[1] - coarse[0]
    fine = np.linspace(best - step, best + step, _FINE)
    return float(fine[np.argmin(_costs(plumbline, fine))])


def _costs(plumbline: Plumbline, divisions: Float64) -> Float64:
    lenses = np.zeros((len(divisions), 4))
    lenses[:, 0] = divisions
    bends = plumbline.bends(straighten(lenses, plumbline.nodes))
    squared = (bends**2 / (2 * _ORDERS + 1)).sum(-1)
    costs = (plumbline.length_px * squared / (squared + NOISE_PX**2)).sum(-1)
    return np.asarray(np.where(is_lens(lenses), costs, np.inf))
