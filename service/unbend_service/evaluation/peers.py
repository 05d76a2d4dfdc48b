"""Peers of the models, run on the same pictures.

**Plumb-line** (Brown 1971; Devernay and Faugeras, "Straight lines have to be straight", 2001): one division parameter
about the picture's centre, the one under which the edge chains are straightest, by a robust cost. No prior, no network
and no way to say no: superb where there are lines, lost where there are not.

**One radial parameter** (the kind of lens that Lopez et al., "Deep Single Image Camera Calibration with Radial
Distortion", 2019, estimate): what a model answers, confined to a division lens about the picture's centre. It shows
what such a family can say of the pictures, and what it cannot.

**Floors**: guides of a given number and degree, fitted to the true map. No answer in such guides can be better.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from unbend_service.adapters.estimators.chains import EdgeChains, extract, fit_long_side
from unbend_service.adapters.estimators.plumbline import Plumbline
from unbend_service.adapters.estimators.radial_family import guides_of_lens, is_lens, straighten
from unbend_service.application.ports import Estimator
from unbend_service.domain.errors import InvalidGuides
from unbend_service.domain.fitting import fit_guides
from unbend_service.domain.guides import Guides
from unbend_service.domain.maps import target_lattice
from unbend_service.evaluation.cases import Case
from unbend_service.evaluation.measures import map_errors

Float64 = npt.NDArray[np.float64]

SEARCHED_LONG_SIDE_PX = 384
FEWEST_CHAINS = 3
NOISE_PX = 0.6
"""Residual at which a chain counts half as bent."""
_RANGE = (-0.25, 0.42)
_COARSE, _FINE = 57, 33
_ORDERS = np.array([2, 3, 4])
_THIRDS = 14
_FEWEST_POINTS = 16


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


def one_radial_parameter(estimator: Estimator, grey: npt.NDArray[np.uint8]) -> Guides:
    """The centred division lens that comes nearest to a model's answer, up to a homography: a bracket, then thirds."""
    height, width = grey.shape
    half = np.array([width, height]) / max(width, height)
    target = target_lattice(15, 15).reshape(-1, 2)
    try:
        answer = estimator.estimate(grey).guides(target)
    except InvalidGuides:
        return guides_of_lens(np.zeros(4), np.eye(3), *half)
    shown = (np.abs(answer) <= 1.1).all(axis=1)
    if shown.sum() < _FEWEST_POINTS:
        return guides_of_lens(np.zeros(4), np.eye(3), *half)

    def distance(division: float) -> float:
        lens = np.array([division, 0.0, 0.0, 0.0])

        def straight(source: Float64) -> Float64:
            return np.asarray(straighten(lens, source * half) / half, np.float64)

        # Both ways round the homography is the same; the lens is given from the source to the target.
        return map_errors(straight, answer[shown], target[shown], half * 128)[1]

    low, high = _RANGE
    for _ in range(_THIRDS):
        third = (high - low) / 3
        if distance(low + third) < distance(high - third):
            high -= third
        else:
            low += third
    return guides_of_lens(np.array([(low + high) / 2, 0.0, 0.0, 0.0]), np.eye(3), *half)


def floor_of(count: int, degree: int, case: Case) -> Guides:
    """The guides of this number and degree that come nearest to the truth."""
    target, source = case.correspondences()
    return fit_guides(source, target, np.linspace(-0.9, 0.9, count), degree, polish=2)
