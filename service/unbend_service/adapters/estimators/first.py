"""The first estimator: a network that looks at the whole picture and answers with points of the guides."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from unbend_service.adapters.estimators.cards import ModelCard
from unbend_service.adapters.estimators.sessions import open_session
from unbend_service.application.ports import Bytes, Estimate, ModelInfo
from unbend_service.domain.errors import ModelUnavailable
from unbend_service.domain.guides import GuideFamily, Guides

Float64 = npt.NDArray[np.float64]

#: Disagreement with the mirrored picture, in picture widths, at which the confidence is one half (3 px at 256).
HALF_CONFIDENCE_WIDTHS = 3 / 256


class FirstEstimator:
    """Guides from a grey picture, squashed to a square, through one convolutional network.

    The network answers with **node values**: where each guide runs at a few fixed positions along it, in the unit
    frame ([0, 1] to the right and down). The polynomial through d + 1 nodes is unique, so the change to coefficients
    in the centred frame is exact. The picture and its mirror image are looked at in one batch and averaged; how far
    the two disagree gives the confidence.

    Args:
        card: its ``parameters`` are ``nodes`` (degree + 1 positions along a guide) and ``anchors`` (K positions), both
            in the unit frame and both symmetric about 0.5, without which a mirrored answer could not be read.
        threads: of one estimate; 0: as many as usable cores.

    Raises:
        ModelUnavailable: weights that cannot be loaded, or that do not fit the parameters of the card.
    """

    def __init__(self, card: ModelCard, threads: int) -> None:
        try:
            self._nodes = np.array(card.parameters["nodes"], dtype=np.float64)
            self._anchors = np.array(card.parameters["anchors"], dtype=np.float64)
        except (KeyError, TypeError, ValueError) as error:
            raise ModelUnavailable(f"The card of {card.name!r} needs nodes and anchors.", setting="model") from error
        for positions in (self._nodes, self._anchors):
            if positions.ndim != 1 or len(positions) < 2 or not np.allclose(positions + positions[::-1], 1):
                raise ModelUnavailable(f"Nodes or anchors of {card.name!r} are not symmetric.", setting="model")
        self._session = open_session(card.weights, threads)
        self._input = self._session.get_inputs()[0]
        shape = self._input.shape
        outputs = self._session.get_outputs()[0].shape
        if len(shape) != 4 or shape[1] != 1 or outputs[-1] != 2 * len(self._anchors) * len(self._nodes):
            raise ModelUnavailable(
                f"The weights of {card.name!r} take {shape} and give {outputs}, not what the card says.",
                setting="model",
            )
        self._height, self._width = int(shape[2]), int(shape[3])
        self._model = ModelInfo(card.name, card.sha256, card.caution)

    @property
    def model(self) -> ModelInfo:
        return self._model

    def estimate(self, grey: Bytes) -> Estimate:
        """Estimates the guides of one picture; thread-safe, blocking, about 10 ms on one core.

        The confidence is ``1 / (1 + (d / HALF_CONFIDENCE_WIDTHS)^2)`` with d the root mean square difference, in
        picture widths, between the node values of the picture and those of its mirror image, mirrored back. It is an
        agreement, not a probability.

        Args:
            grey: (height, width) uint8, any size, upright.

        Returns:
            Guides in the centred frame; ``confidence_kind`` is ``mirror_agreement``.

        Raises:
            InvalidGuides: the network's answer is no set of guides (never seen; a guard).
        """
        small = cv2.resize(grey, (self._width, self._height), interpolation=cv2.INTER_AREA)
        image = small.astype(np.float32) / np.float32(255)
        batch = np.stack([image, image[:, ::-1]])[:, None]
        answer = self._session.run(None, {self._input.name: batch})[0]
        nodes = np.asarray(answer, dtype=np.float64).reshape(2, 2, len(self._anchors), len(self._nodes))
        direct, mirrored = nodes[0], mirrored_nodes(nodes[1])
        disagreement = float(np.sqrt(np.mean((direct - mirrored) ** 2)))
        return Estimate(
            guides=guides_from_nodes((direct + mirrored) / 2, self._nodes, self._anchors),
            confidence=1 / (1 + (disagreement / HALF_CONFIDENCE_WIDTHS) ** 2),
            confidence_kind="mirror_agreement",
            model=self._model,
        )


def mirrored_nodes(values: Float64) -> Float64:
    """Node values of the picture mirrored left to right.

    A row guide is run through backwards; a column guide lies as far from the other side, and the order of the
    columns turns round. Nodes and anchors are symmetric about 0.5.

    Args:
        values: (2, K, degree + 1) float64 unit frame: row guides, then column guides.

    Returns:
        (2, K, degree + 1) float64 unit frame.
    """
    return np.stack([values[0][:, ::-1], 1 - values[1][::-1]])


def guides_from_nodes(values: Float64, nodes: Float64, anchors: Float64) -> Guides:
    """The polynomials through node values, in the centred frame; exact.

    Args:
        values: (2, K, degree + 1) float64 unit frame, ``values[0, i, k]`` the height v of row guide i at u = nodes[k],
            ``values[1, j, k]`` the u of column guide j at v = nodes[k].
        nodes: (degree + 1,) float64 unit frame.
        anchors: (K,) float64 unit frame.

    Raises:
        InvalidGuides: values that are not finite or far outside the picture.
    """
    powers = np.vander(2 * nodes - 1, increasing=True)
    coefficients = np.linalg.solve(powers, (2 * values - 1).transpose(0, 2, 1)).transpose(0, 2, 1)
    centred_anchors = 2 * anchors - 1
    return Guides(GuideFamily(centred_anchors, coefficients[0]), GuideFamily(centred_anchors, coefficients[1]))
