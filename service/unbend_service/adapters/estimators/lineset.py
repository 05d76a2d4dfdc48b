"""The line-set estimator: what the straight edges of a picture say about the lens that bent them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from unbend_service.adapters.estimators.cards import ModelCard
from unbend_service.adapters.estimators.chain_features import FEATURES, ChainPoints, describe
from unbend_service.adapters.estimators.chains import extract, fit_long_side
from unbend_service.adapters.estimators.sessions import open_session
from unbend_service.application.ports import Bytes, Estimate, ModelInfo
from unbend_service.domain.errors import ModelUnavailable
from unbend_service.domain.guides import GuideFamily, Guides, lagrange_basis

Float64 = npt.NDArray[np.float64]

#: Fewer edge chains than this say nothing about a lens.
FEWEST_CHAINS = 4
#: Pixels of a 256 picture per half picture width.
_PIXELS = 128.0
_LATTICE = 13


@dataclass(frozen=True, slots=True)
class Evidence:
    """What the confidence is computed from; lengths in pixels of a picture whose long side has 256.

    Attributes:
        expected_error: error of the nonlinear part that the network expects of itself.
        displacement: mean displacement of the nonlinear part of the estimate.
        disagreement: mean difference of the nonlinear parts estimated from the picture and from its mirror image.
        chains: edge chains that were looked at.
    """

    expected_error: float
    displacement: float
    disagreement: float
    chains: int

    def inputs(self) -> Float64:
        """(6,) float64: the inputs of the logistic regression of the card, the first of them 1."""
        error = math.log(max(self.expected_error, 0.01))
        size = math.log(max(self.displacement, 0.01))
        apart = math.log(max(self.disagreement, 0.01))
        return np.array([1.0, error, size, apart, math.log1p(self.chains), max(size - error, 0.0)])


class LinesetEstimator:
    """Guides from the edge chains of a grey picture, through one set network.

    The picture is reduced, never enlarged and never squashed: chains live in the isotropic frame, so a lens keeps its
    shape whatever the aspect of the picture. The network's answer, node values in that frame, is changed to
    coefficients in the centred frame exactly: the guides' map is a polynomial in each variable, and so is its
    restriction to a smaller rectangle. The picture and its mirror image are looked at in one batch and averaged.

    Args:
        card: its ``parameters`` are ``nodes`` (degree + 1 positions along a guide) and ``anchors`` (K positions), both
            in the isotropic frame and symmetric about 0; ``searched_long_side_px``; ``confidence``, the weights of a
            logistic regression over :meth:`Evidence.inputs`.
        threads: of one estimate; 0: as many as usable cores.

    Raises:
        ModelUnavailable: weights that cannot be loaded, or that do not fit the parameters of the card.
    """

    def __init__(self, card: ModelCard, threads: int) -> None:
        try:
            self._nodes = np.array(card.parameters["nodes"], dtype=np.float64)
            self._anchors = np.array(card.parameters["anchors"], dtype=np.float64)
            self._long_side_px = int(card.parameters["searched_long_side_px"])
            self._weights = np.array(card.parameters["confidence"], dtype=np.float64)
        except (KeyError, TypeError, ValueError) as error:
            raise ModelUnavailable(f"The card of {card.name!r} is incomplete: {error!r}.", setting="model") from error
        for positions in (self._nodes, self._anchors):
            if positions.ndim != 1 or len(positions) < 2 or not np.allclose(positions, -positions[::-1]):
                raise ModelUnavailable(f"Nodes or anchors of {card.name!r} are not symmetric.", setting="model")
        self._session = open_session(card.weights, threads)
        features = self._session.get_inputs()[0].shape
        values = self._session.get_outputs()[0].shape
        if features[-1] != FEATURES or values[-1] != 2 * len(self._anchors) * len(self._nodes):
            raise ModelUnavailable(
                f"The weights of {card.name!r} take {features} and give {values}, not what the card says.",
                setting="model",
            )
        self._model = ModelInfo(card.name, card.sha256)

    @property
    def model(self) -> ModelInfo:
        return self._model

    def estimate(self, grey: Bytes) -> Estimate:
        """Estimates the guides of one picture; thread-safe, blocking, about 20 ms on one core.

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
        chains = extract(fit_long_side(grey, self._long_side_px))
        points = ChainPoints.of(chains)
        direct, mirrored = describe(points), describe(points.mirrored())
        slots = len(direct.features)
        if slots < FEWEST_CHAINS:
            return Guides.straight(), None
        pairs = [described.padded(slots) for described in (direct, mirrored)]
        values, spreads = self._session.run(
            ["nodes", "spreads"],
            {"features": np.concatenate([p[0] for p in pairs]), "mask": np.concatenate([p[1] for p in pairs])},
        )
        shape = (2, len(self._anchors), len(self._nodes))
        one = np.asarray(values[0], dtype=np.float64).reshape(shape)
        other = mirrored_values(np.asarray(values[1], dtype=np.float64).reshape(shape))
        mean = (one + other) / 2
        evidence = self._evidence(mean, one - other, spreads, points.half_extent[0].astype(np.float64), slots)
        guides = guides_from_isotropic(mean, self._nodes, self._anchors, chains.half_width, chains.half_height)
        return guides, evidence

    def _evidence(
        self, mean: Float64, difference: Float64, spreads: npt.NDArray[np.float32], half_extent: Float64, chains: int
    ) -> Evidence:
        straight = np.broadcast_to(self._anchors[:, None], mean[0].shape)
        return Evidence(
            expected_error=float(np.exp(np.clip(np.asarray(spreads)[:, -1], -4, 5).mean())),
            displacement=self._bend(mean - straight, half_extent),
            disagreement=self._bend(difference, half_extent) / 2,
            chains=chains,
        )

    def _bend(self, offset: Float64, half_extent: Float64) -> float:
        """Mean displacement, px, of what no infinitesimal homography explains of small node value offsets (2, K, d+1),
        over a lattice of the picture."""
        steps = np.linspace(-1, 1, _LATTICE)
        x, y = (a.ravel() * h for a, h in zip(np.meshgrid(steps, steps), half_extent, strict=True))
        down = np.einsum("nk,nd,kd->n", lagrange_basis(self._anchors, y), lagrange_basis(self._nodes, x), offset[0])
        right = np.einsum("nk,nd,kd->n", lagrange_basis(self._anchors, x), lagrange_basis(self._nodes, y), offset[1])
        one, zero = np.ones_like(x), np.zeros_like(x)
        tangents = np.concatenate(
            [
                np.stack([one, zero, x, zero, y, zero, x * x, x * y], 1),
                np.stack([zero, one, zero, x, zero, y, x * y, y * y], 1),
            ]
        )
        moved = np.concatenate([right, down])
        rest = moved - tangents @ np.linalg.lstsq(tangents, moved, rcond=None)[0]
        return float(np.hypot(*rest.reshape(2, -1)).mean() * _PIXELS)


def mirrored_values(values: Float64) -> Float64:
    """Node values (2, K, degree + 1), isotropic frame, of the picture mirrored left to right.

    A row guide is run through backwards; a column guide lies as far from the other side, and the order of the columns
    turns round. Nodes and anchors are symmetric about 0.
    """
    return np.stack([values[0][:, ::-1], -values[1][::-1]])


def guides_from_isotropic(
    values: Float64, nodes: Float64, anchors: Float64, half_width: float, half_height: float
) -> Guides:
    """Guides in the centred frame from node values in the isotropic frame; exact.

    The isotropic guides define y = sum_k L_k(t) P_k(x) with L the Lagrange basis over the anchors; at the target
    heights a h of the centred anchors a this is one polynomial each, to which x = w x_c and y = h y_c are applied.

    Args:
        values: (2, K, degree + 1) float64: ``values[0, i, k]`` is the y of row guide i at x = nodes[k],
            ``values[1, j, k]`` the x of column guide j at y = nodes[k].
        nodes: (degree + 1,) float64. anchors: (K,) float64. Both isotropic, symmetric about 0.
        half_width, half_height: of the picture in the isotropic frame, w and h above.

    Raises:
        InvalidGuides: values that are not finite or far outside the picture.
    """
    powers = np.vander(nodes, increasing=True)
    coefficients = np.linalg.solve(powers, values.transpose(0, 2, 1)).transpose(0, 2, 1)
    exponents = np.arange(len(nodes))
    rows = lagrange_basis(anchors, anchors * half_height) @ coefficients[0] * half_width**exponents / half_height
    columns = lagrange_basis(anchors, anchors * half_width) @ coefficients[1] * half_height**exponents / half_width
    return Guides(GuideFamily(anchors, rows), GuideFamily(anchors, columns))
