"""Is it a lens, nothing at all, or something else? Chains and a network's guides, weighed together.

Most real distortion is radial, and a lens of a few numbers, fitted to the edge chains, is several times more exact than
guides that were guessed; but where there are few straight edges the guess is better, and a wave is no lens. So three
kinds of hypotheses are compared by their evidence (log marginal likelihood):

    identity   nothing but pose
    radial     the division lens, one number (centred) or four (second term, free centre)
    guides     what the network said, whatever shape it has

All explain two observations. The **chains**, through the likelihood in `plumbline`. And the **guides** themselves,
taken as a noisy view of the truth: at rms distance d from the truth, up to the best homography, a Student density
(1 + d^2 / (NU e^2))^(-(NU + DIMENSIONS)/2), e being the error that the network expects of itself. Lenses are fitted by
Gauss-Newton to both at once, and pay for their freedom by Laplace's approximation of the evidence (MacKay,
"Bayesian interpolation", 1992); guides, which fit themselves, pay for as many dimensions as the Student density has.

Lengths called px are of a picture whose long side has 256; everything is in the isotropic frame (see `chains`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from unbend_service.adapters.estimators.chains import EdgeChains
from unbend_service.adapters.estimators.guides_view import PIXELS, GuidesView
from unbend_service.adapters.estimators.plumbline import Plumbline
from unbend_service.adapters.estimators.radial_family import (
    IDENTITY,
    guides_of_lens,
    is_lens,
    straighten,
    straighten_axes,
)
from unbend_service.domain.errors import InvalidGuides
from unbend_service.domain.guides import Guides

Float64 = npt.NDArray[np.float64]
Kind = Literal["identity", "radial", "guides"]

FEWEST_CHAINS = 5
"""With fewer there is nothing to add to what the network says."""
USUAL_ERROR_PX = 1.0
"""Of guides that come without an expected error."""
LEAST_ERROR_PX = 0.25
NU = 5.0
DIMENSIONS = 6.0
"""Of the Student density of the network's error: heaviness of its tails, independent directions."""
NATURAL_BEND_PX = 3.0
"""Size of distortions that are neither nothing nor radial."""
LOG_PRIOR = {"identity": -1.0, "centred": -0.7, "free": 0.3, "guides": -1.0}
"""Up to a constant. Chosen with NU and DIMENSIONS on training photographs under known distortions; the figures lie on
a plateau two units wide."""
PRIOR_SPREAD: Float64 = np.array([0.25, 0.06, 0.06, 0.06])
"""Of l1, l2, cx, cy."""

_CENTRED = np.array([0])
_FREE = np.array([0, 1, 2, 3])
_SCAN = np.linspace(-0.4, 0.42, 15)
_CENTRES: Float64 = 0.08 * np.stack(np.meshgrid([0.0, -1.0, 1.0], [0.0, -1.0, 1.0]), axis=-1).reshape(-1, 2)
_STRONG_PINCUSHION = 0.1
_STRONG_POSE = 0.15
_STEPS = np.array([1e-3, 1e-3, 2e-3, 2e-3])
_ROUNDS = 9
_SHARPENING_ROUNDS = 6
_SETTLED = 1e-2
_SHARP = 1e-5
"""Steps get ten times smaller or more from one to the next: what is left after one like this is a ten-thousandth of a
pixel."""


@dataclass(frozen=True, slots=True)
class Refinement:
    """What is believed after chains and guides were weighed.

    Attributes:
        guides: centred frame, pose included, so that ``nonlinear`` and ``all`` corrections both work.
        kind: the hypothesis that won.
        expected_error: rms error of the nonlinear part, px: the spread of the winner, and its distance from the
            losers as far as they are probable.
        probabilities: of ``identity``, ``radial`` and ``guides``; they add up to 1.
        lens: (l1, l2, cx, cy) of a radial winner, isotropic; None otherwise.
        chains: edge chains that had a say.
    """

    guides: Guides
    kind: Kind
    expected_error: float
    probabilities: dict[Kind, float]
    lens: Float64 | None
    chains: int


@dataclass(frozen=True)
class _Hypothesis:
    """A candidate: its nonlinear displacement (2 n,) px over the lattice, log evidence, and own rms error px."""

    kind: Kind
    residual: Float64
    log_evidence: float
    spread: float
    lens: Float64 | None = None


def refine(chains: EdgeChains, guides: Guides, guide_error: float | None) -> Refinement:
    """Weighs what the network said against what the chains say; about 20 ms on one core, thread-safe.

    Args:
        chains: of the picture, isotropic frame.
        guides: of the same picture, centred frame.
        guide_error: error of the nonlinear part that the network expects of its guides, px; None if it has no say.

    Raises:
        Nothing: where chains or guides are of no use the guides come back as they are.
    """
    error = USUAL_ERROR_PX if guide_error is None else max(guide_error, LEAST_ERROR_PX)
    plumbline = Plumbline(chains)
    if plumbline.count < FEWEST_CHAINS:
        return _unchanged(guides, error, plumbline.count)
    try:
        view = GuidesView(guides, chains.half_width, chains.half_height)
    except InvalidGuides:
        return _unchanged(guides, error, plumbline.count)
    model = _Model(plumbline, view, error)
    start, said = model.scan()
    centred = model.fit(start, _CENTRED)
    hypotheses = [model.identity(), centred, model.fit(model.scan_centres(centred), _FREE), model.guides()]
    scores = np.array([h.log_evidence for h in hypotheses])
    probability = np.exp(scores - np.logaddexp.reduce(scores))
    best = hypotheses[int(np.argmax(probability))]
    apart = np.array([2 * ((h.residual - best.residual) ** 2).mean() + h.spread**2 for h in hypotheses])
    sums: dict[Kind, float] = {"identity": 0.0, "radial": 0.0, "guides": 0.0}
    for hypothesis, share in zip(hypotheses, probability, strict=True):
        sums[hypothesis.kind] += float(share)
    refined = guides
    if best.kind != "guides":
        lens = IDENTITY if best.lens is None else best.lens
        # The pose is what the guides say beyond *their* lens: a better lens must not change it.
        pose = _kept_pose(view.pose(straighten(said, view.source)), lens)
        try:
            refined = guides_of_lens(lens, pose, chains.half_width, chains.half_height)
        except InvalidGuides:
            return _unchanged(guides, error, plumbline.count)
    return Refinement(refined, best.kind, float(np.sqrt(probability @ apart)), sums, best.lens, plumbline.count)


def _kept_pose(pose: Float64, lens: Float64) -> Float64:
    """``pose``, or none where guides cannot hold it together with the lens.

    A strong pincushion leaves target points without a source. Guides go on there, and seen askew they meet again in
    wrong places; the plane part taken from such a map is wild. The lens matters more than a pose like that.
    """
    wild = lens[0] > _STRONG_PINCUSHION and np.abs(pose - np.eye(3)).max() > _STRONG_POSE
    return np.eye(3) if wild else pose


def _unchanged(guides: Guides, error: float, chains: int) -> Refinement:
    return Refinement(guides, "guides", error, {"identity": 0.0, "radial": 0.0, "guides": 1.0}, None, chains)


@dataclass(frozen=True)
class _State:
    """A lens and its neighbours: parameters (1 + k, 4), bends (1 + k, chains, 3), residual (1 + k, 2 n)."""

    parameters: Float64
    bends: Float64
    residual: Float64
    cost: Float64


class _Model:
    """Costs (negative log posteriors) of lenses."""

    def __init__(self, plumbline: Plumbline, view: GuidesView, error: float) -> None:
        self._plumbline = plumbline
        self._view = view
        self._error = error
        self._count = len(view.source)
        self._x, self._y = np.ascontiguousarray(np.concatenate([plumbline.nodes, view.source]).T)
        self._pose: Float64 | None = None

    def scan(self) -> tuple[Float64, Float64]:
        """Of centred one-number lenses, each (4,): the best of a coarse scan, and the one nearest to the guides alone
        (through the parabola of its squared distance)."""
        lenses = np.zeros((len(_SCAN), 4))
        lenses[:, 0] = _SCAN
        state = self._look(lenses)
        far = (state.residual**2).sum(-1) / self._count
        nearest = int(np.clip(np.argmin(far), 1, len(far) - 2))
        before, here, after = far[nearest - 1 : nearest + 2]
        bottom = np.clip(0.5 * (before - after) / max(before - 2 * here + after, 1e-9), -1, 1)
        said = np.array([_SCAN[nearest] + bottom * (_SCAN[1] - _SCAN[0]), 0.0, 0.0, 0.0])
        return lenses[int(np.argmin(state.cost))], said

    def scan_centres(self, near: _Hypothesis) -> Float64:
        """The best of a lens and its likes with other centres, (4,)."""
        lenses = np.repeat((IDENTITY if near.lens is None else near.lens)[None], len(_CENTRES), axis=0)
        lenses[:, 2:] += _CENTRES
        return np.asarray(lenses[int(np.argmin(self._look(lenses).cost))])

    def identity(self) -> _Hypothesis:
        state = self._look(IDENTITY[None])
        return _Hypothesis("identity", state.residual[0], float(LOG_PRIOR["identity"] - state.cost[0]), 0.0)

    def guides(self) -> _Hypothesis:
        bends = self._plumbline.bends(self._view.straighten(self._plumbline.nodes))
        said = float(self._plumbline.log_likelihood(bends))
        freedom = 0.5 * DIMENSIONS * np.log1p((NATURAL_BEND_PX / self._error) ** 2)
        nothing = np.zeros(2 * self._count)
        return _Hypothesis("guides", nothing, float(LOG_PRIOR["guides"] + said - freedom), self._error)

    def fit(self, start: Float64, free: npt.NDArray[np.int64]) -> _Hypothesis:
        """The most probable lens with the ``free`` parameters, and its evidence, by Levenberg-Marquardt."""
        self._pose = self._view.pose(straighten(start, self._view.source))
        state = self._around(start, free)
        damping, normal = 1e-3, np.eye(len(free))
        for _ in range(_ROUNDS):
            normal, slope = self._normal(state, free)
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), -slope)
            tried = state.parameters[0].copy()
            tried[free] += step
            following = self._around(tried, free)
            gain = float(state.cost[0] - following.cost[0])
            if gain > 0:
                state, damping = following, damping / 10
                if gain < _SETTLED:
                    break
            else:
                damping = max(10 * damping, 1e-2)
                if damping > 1e3:
                    break
        normal, _ = self._normal(state, free)
        _, volume = np.linalg.slogdet(normal * np.outer(PRIOR_SPREAD[free], PRIOR_SPREAD[free]))
        sensitivity = self._sensitivity(state, free)
        spread = np.sqrt(np.trace(np.linalg.solve(normal, sensitivity.T @ sensitivity)))
        evidence = LOG_PRIOR["free" if len(free) > 1 else "centred"] - state.cost[0] - 0.5 * volume
        state = self._sharpened(state, free, normal)
        return _Hypothesis("radial", state.residual[0], float(evidence), float(spread), state.parameters[0])

    def _sharpened(self, state: _State, free: npt.NDArray[np.int64], normal: Float64) -> _State:
        """The last tenth of a pixel: Cauchy's cost at the spread of this picture's own straight chains.

        The mixture is flat near its top, where every chain is as straight as chains usually are. The fit so far, with
        its Hessian ``normal``, is the prior of this one.
        """
        begun = state.parameters[0, free]
        for _ in range(_SHARPENING_ROUNDS):
            weight, spread = self._plumbline.sure(state.bends[0])
            if not weight.any():
                break

            def cost(found: _State, weight: Float64 = weight, spread: Float64 = spread) -> float:
                away = found.parameters[0, free] - begun
                square = ((found.bends[0] / spread) ** 2).sum(-1) / 2
                return float(weight @ np.log1p(square) + 0.5 * away @ normal @ away)

            square = ((state.bends[0] / spread) ** 2).sum(-1) / 2
            pull = ((weight / (1 + square))[:, None] / spread**2).ravel()
            bend = (state.bends[1:] - state.bends[0]).reshape(len(free), -1).T / _STEPS[free]
            slope = bend.T @ (pull * state.bends[0].ravel()) + normal @ (state.parameters[0, free] - begun)
            step = np.linalg.solve((bend.T * pull) @ bend + normal, slope)
            tried = state.parameters[0].copy()
            tried[free] -= step
            following = self._around(tried, free)
            if cost(following) >= cost(state) or not np.isfinite(following.cost[0]):
                break
            state = following
            if np.abs(step).max() < _SHARP:
                break
        return state

    def _around(self, lens: Float64, free: npt.NDArray[np.int64]) -> _State:
        lenses = np.repeat(lens[None], 1 + len(free), axis=0)
        lenses[1 + np.arange(len(free)), free] += _STEPS[free]
        return self._look(lenses)

    def _look(self, lenses: Float64) -> _State:
        x, y = straighten_axes(lenses, self._x, self._y)
        bends = self._plumbline.bends_of_axes(x[:, : -self._count], y[:, : -self._count])
        x, y = x[:, -self._count :], y[:, -self._count :]
        if self._pose is None:
            residual = self._view.residual(np.stack([x, y], axis=-1))
        else:
            residual = self._view.residual_near(x, y, self._pose)
        far = (residual * residual).sum(-1) / self._count
        cost = 0.5 * ((lenses / PRIOR_SPREAD) ** 2).sum(-1) - self._plumbline.log_likelihood(bends)
        cost += 0.5 * (NU + DIMENSIONS) * np.log1p(far / (NU * self._error**2))
        return _State(lenses, bends, residual, np.where(is_lens(lenses), cost, np.inf))

    def _sensitivity(self, state: _State, free: npt.NDArray[np.int64]) -> Float64:
        """(2 n, k) derivative of the nonlinear displacement, scaled so that its square is a mean over the lattice."""
        difference = state.residual[1:] - state.residual[0]
        return np.asarray((difference / _STEPS[free, None]).T / np.sqrt(self._count))

    def _normal(self, state: _State, free: npt.NDArray[np.int64]) -> tuple[Float64, Float64]:
        """Hessian (k, k) of the reweighted cost and its gradient (k,)."""
        prior = 1 / PRIOR_SPREAD[free] ** 2
        weight = self._plumbline.precision(state.bends[0]).ravel()
        bend = (state.bends[1:] - state.bends[0]).reshape(len(free), -1).T / _STEPS[free]
        moved = self._sensitivity(state, free)
        residual = state.residual[0] / np.sqrt(self._count)
        pull = (NU + DIMENSIONS) / (NU * self._error**2 + residual @ residual)
        normal = np.diag(prior) + (bend.T * weight) @ bend + pull * moved.T @ moved
        slope = prior * state.parameters[0, free] + bend.T @ (weight * state.bends[0].ravel())
        return normal, slope + pull * moved.T @ residual


__all__ = ["PIXELS", "Kind", "Refinement", "refine"]
