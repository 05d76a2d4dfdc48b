"""The line-set estimator: what the straight edges of a picture say about the lens that bent them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from unbend_service.adapters.estimators.cards import ModelCard
from unbend_service.adapters.estimators.chain_features import FEATURES, ChainPoints, describe
from unbend_service.adapters.estimators.chains import extract, fit_long_side
from unbend_service.adapters.estimators.isotropic_guides import GuideFrame, mirrored
from unbend_service.adapters.estimators.picture_branch import ChainsAnswer, Fused, PictureBranch
from unbend_service.adapters.estimators.radial import refine
from unbend_service.adapters.estimators.radial_family import displacement_of_lens
from unbend_service.adapters.estimators.sessions import open_session
from unbend_service.application.ports import Bytes, Estimate, ModelInfo
from unbend_service.domain.errors import InvalidGuides, ModelUnavailable
from unbend_service.domain.guides import Guides

Float64 = npt.NDArray[np.float64]

#: Fewer edge chains than this say nothing about a lens.
FEWEST_CHAINS = 4
INPUTS = 9
#: Pixels of a 256 picture per half picture width.
_PIXELS = 128.0
#: Displacement from which a second look pays: it takes a fifth off the error of strong lenses, and unsettles the rest.
SECOND_LOOK_FROM_PX = 2.0
#: Where less is to be done, no lens is looked for.
LEAST_DISPLACEMENT_PX = 0.15
#: A radial lens takes the place of the guides when it is at least this probable, and the guides were not a mere guess:
#: where chains say little a lens of a few numbers is as wrong as any, and surer of itself.
RADIAL_FROM = 0.6
LENSES_UP_TO_PX = 1.5
#: Straightened points further out than this, in half extents of the picture, are not looked at again.
_SECOND_LOOK_EXTENT = 1.3


@dataclass(frozen=True, slots=True)
class Evidence:
    """What the confidence is computed from; lengths in pixels of a picture whose long side has 256.

    Attributes:
        expected_error: error of the nonlinear part that the network expects of itself.
        displacement: mean displacement of the nonlinear part of the estimate.
        disagreement: mean difference of the nonlinear parts estimated from the picture and from its mirror image.
        chains: edge chains that were looked at.
        departure: mean difference of the nonlinear parts that the chains alone and the networks together suggest.
        radial, straight: probabilities that the distortion is that of a radial lens, and that there is none.
    """

    expected_error: float
    displacement: float
    disagreement: float
    chains: int
    departure: float
    radial: float
    straight: float

    def inputs(self) -> Float64:
        """(INPUTS,) float64: the inputs of the logistic regression of the card, the first of them 1."""
        error = math.log(max(self.expected_error, 0.01))
        size = math.log(max(self.displacement, 0.01))
        apart = math.log(max(self.disagreement, 0.01))
        parted = math.log(max(self.departure, 0.01))
        surplus, chains = max(size - error, 0.0), math.log1p(self.chains)
        return np.array([1.0, error, size, apart, chains, surplus, self.radial, self.straight, parted])


class LinesetEstimator:
    """Guides from the edge chains of a grey picture, through a set network and what stands beside it.

    The picture is reduced, never enlarged and never squashed: chains live in the isotropic frame, so a lens keeps its
    shape whatever the aspect of the picture. The picture and its mirror image are looked at in one batch and averaged.
    With two ``looks`` the chains of a strong distortion are then straightened by the first estimate and looked at
    again, and both maps are composed: what the first look left of it is a weak one.

    With a ``branch`` in the card a second network looks at the picture itself, and decides at the first look whom to
    follow (`picture_branch`). At last a radial lens of a few numbers takes the place of the guides where the chains
    speak for it (`radial`); it comes as eight guides a direction, whatever the network's number.

    Args:
        card: its ``parameters`` are ``nodes`` (degree + 1 positions along a guide) and ``anchors`` (K positions), both
            in the isotropic frame and symmetric about 0; ``searched_long_side_px``; ``looks``, 1 or 2; ``confidence``,
            the weights of a logistic regression over :meth:`Evidence.inputs`.
        threads: of one estimate; 0: as many as usable cores.

    Raises:
        ModelUnavailable: weights that cannot be loaded, or that do not fit the parameters of the card.
    """

    def __init__(self, card: ModelCard, threads: int) -> None:
        try:
            self._frame = GuideFrame(
                nodes=np.array(card.parameters["nodes"], dtype=np.float64),
                anchors=np.array(card.parameters["anchors"], dtype=np.float64),
            )
            self._long_side_px = int(card.parameters["searched_long_side_px"])
            self._looks = int(card.parameters["looks"])
            self._weights = np.array(card.parameters["confidence"], dtype=np.float64)
        except (KeyError, TypeError, ValueError) as error:
            raise ModelUnavailable(f"The card of {card.name!r} is incomplete: {error!r}.", setting="model") from error
        for positions in (self._frame.nodes, self._frame.anchors):
            if positions.ndim != 1 or len(positions) < 2 or not np.allclose(positions, -positions[::-1]):
                raise ModelUnavailable(f"Nodes or anchors of {card.name!r} are not symmetric.", setting="model")
        if self._weights.shape != (INPUTS,):
            raise ModelUnavailable(f"The card of {card.name!r} needs {INPUTS} confidence weights.", setting="model")
        self._session = open_session(card.weights, threads)
        self._branch = PictureBranch(card, threads) if "branch" in card.parameters else None
        features = self._session.get_inputs()[0].shape
        values = self._session.get_outputs()[0].shape
        if features[-1] != FEATURES or values[-1] != self._frame.straight.size:
            raise ModelUnavailable(
                f"The weights of {card.name!r} take {features} and give {values}, not what the card says.",
                setting="model",
            )
        self._model = ModelInfo(card.name, card.sha256, card.caution)

    @property
    def model(self) -> ModelInfo:
        return self._model

    def estimate(self, grey: Bytes) -> Estimate:
        """Estimates the guides of one picture; thread-safe, blocking, about 25 ms on two cores.

        Args:
            grey: (height, width) uint8, any size, upright.

        Returns:
            Guides in the centred frame. The confidence is the probability that the picture, its nonlinear part
            corrected, is nearer to straight than it was (``calibrated_probability``); ``expected_error`` is that of
            the nonlinear part. A picture with hardly an edge gets straight guides and confidence 0.

        Raises:
            InvalidGuides: the network's answer is no set of guides (never seen; a guard).
        """
        guides, evidence = self.examine(grey)
        return Estimate(
            guides=guides,
            confidence=self.confidence(evidence),
            confidence_kind="calibrated_probability",
            model=self._model,
            expected_error=None if evidence is None else evidence.expected_error / _PIXELS,
        )

    def confidence(self, evidence: Evidence | None) -> float:
        """Probability that a correction backed by this evidence makes the picture straighter; 0 without evidence."""
        if evidence is None:
            return 0.0
        return float(1 / (1 + np.exp(-np.clip(self._weights @ evidence.inputs(), -30, 30))))

    def examine(self, grey: Bytes) -> tuple[Guides, Evidence | None]:
        """The guides of a (height, width) uint8 picture and what speaks for them; straight guides and None where
        there are too few edges to say anything."""
        picture = fit_long_side(grey, self._long_side_px)
        fused = None if self._branch is None else self._branch.look(picture)
        chains = extract(picture)
        points = ChainPoints.of(chains)
        extent = (chains.half_width, chains.half_height)
        seen = self._look(points, fused)
        if seen is None:
            return Guides.straight(), None
        values = seen.values
        displacement = self._displacement(values, extent)
        if self._looks > 1 and displacement > SECOND_LOOK_FROM_PX:
            values = self._second_look(points, values, extent)
            displacement = self._displacement(values, extent)
        guides, error = self._frame.guides(values, *extent), seen.expected_error
        radial, straight = 0.0, 0.0
        if displacement > LEAST_DISPLACEMENT_PX:
            weighed = refine(chains, guides, error)
            radial, straight = weighed.probabilities["radial"], weighed.probabilities["identity"]
            if weighed.lens is not None and radial > RADIAL_FROM and error < LENSES_UP_TO_PX:
                guides, error = weighed.guides, weighed.expected_error
                displacement = displacement_of_lens(weighed.lens, *extent) * _PIXELS
        evidence = Evidence(
            expected_error=error,
            displacement=displacement,
            disagreement=self._frame.bend(seen.difference, *extent) * _PIXELS,
            chains=seen.chains,
            departure=self._frame.bend(seen.departure, *extent) * _PIXELS,
            radial=radial,
            straight=straight,
        )
        return guides, evidence

    def _displacement(self, values: Float64, extent: tuple[float, float]) -> float:
        return self._frame.bend(values - self._frame.straight, *extent) * _PIXELS

    def _look(self, points: ChainPoints, fused: Fused | None = None) -> _Look | None:
        """What the network says of chains, ``fused`` with what the picture shows, and of their mirror images; None if
        there is too little to say anything."""
        direct, reflected = describe(points), describe(points.mirrored())
        slots = max(len(direct.features), len(reflected.features))
        if slots < FEWEST_CHAINS:
            return None
        pairs = [described.padded(slots) for described in (direct, reflected)]
        told = {"features": np.concatenate([p[0] for p in pairs]), "mask": np.concatenate([p[1] for p in pairs])}
        shape = (2, *self._frame.straight.shape)
        if fused is None:
            nodes, spreads = (np.asarray(output) for output in self._session.run(["nodes", "spreads"], told))
            log_errors, departure = spreads[:, -2:], np.zeros(shape[1:])
        else:
            answer = ChainsAnswer(*map(np.asarray, self._session.run(["nodes", "spreads", "state"], told)))
            nodes, log_errors = fused(answer)
            departure = (nodes - answer.nodes)[0].reshape(shape[1:]).astype(np.float64)
        one, other = nodes.astype(np.float64).reshape(shape)
        other = mirrored(other)
        expected_error = float(np.exp(np.clip(log_errors[:, -1], -4, 5).mean()))
        return _Look((one + other) / 2, (one - other) / 2, departure, expected_error, len(direct.features))

    def _second_look(self, points: ChainPoints, values: Float64, extent: tuple[float, float]) -> Float64:
        """The values after looking at the chains that `values` straighten; unchanged where that is of no use."""
        s, t = self._frame.straightened(values, points.x.astype(np.float64), points.y.astype(np.float64))
        inside = (np.abs(s) < _SECOND_LOOK_EXTENT * extent[0]) & (np.abs(t) < _SECOND_LOOK_EXTENT * extent[1])
        rest = self._look(points.moved(s.astype(np.float32), t.astype(np.float32)).kept(inside))
        if rest is None:
            return values
        try:
            return self._frame.composed(values, rest.values, *extent)
        except InvalidGuides:
            return values


@dataclass(frozen=True, slots=True)
class _Look:
    """Mean of what the picture and its mirror image say, half their difference, how far the picture branch departed
    from the chains (each (2, K, degree + 1)), and the rest."""

    values: Float64
    difference: Float64
    departure: Float64
    expected_error: float
    chains: int
