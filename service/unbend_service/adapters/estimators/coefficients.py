"""The paper's estimator: a grey square in, the sixteen coefficients of four cubic guides out."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from unbend_service.adapters.estimators.cards import ModelCard
from unbend_service.adapters.estimators.first import HALF_CONFIDENCE_WIDTHS
from unbend_service.adapters.estimators.sessions import open_session
from unbend_service.application.ports import Bytes, Estimate, ModelInfo
from unbend_service.domain.errors import ModelUnavailable
from unbend_service.domain.guides import GuideFamily, Guides

Float64 = npt.NDArray[np.float64]


class CoefficientsEstimator:
    """Guides from a grey picture, squashed to a square, through a network that answers with their coefficients.

    The picture and its mirror image are looked at in one batch and averaged; how far the two disagree gives the
    confidence, as with :class:`~.first.FirstEstimator`.

    Args:
        card: its ``parameters`` are ``anchors`` (K positions in the centred frame, symmetric about 0) and ``degree``.
        threads: of one estimate; 0: as many as usable cores.

    Raises:
        ModelUnavailable: weights that cannot be loaded, or that do not fit the parameters of the card.
    """

    def __init__(self, card: ModelCard, threads: int) -> None:
        try:
            self._anchors = np.array(card.parameters["anchors"], dtype=np.float64)
            self._terms = int(card.parameters["degree"]) + 1
        except (KeyError, TypeError, ValueError) as error:
            raise ModelUnavailable(f"The card of {card.name!r} needs anchors and a degree.", setting="model") from error
        if self._anchors.ndim != 1 or not np.allclose(self._anchors, -self._anchors[::-1]):
            raise ModelUnavailable(f"The anchors of {card.name!r} are not symmetric.", setting="model")
        self._session = open_session(card.weights, threads)
        self._input = self._session.get_inputs()[0]
        shape, outputs = self._input.shape, self._session.get_outputs()[0].shape
        if len(shape) != 4 or shape[1] != 1 or outputs[-1] != 2 * len(self._anchors) * self._terms:
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
        """Estimates the guides of one picture; thread-safe, blocking.

        Args:
            grey: (height, width) uint8, any size, upright.

        Returns:
            Guides in the centred frame; ``confidence_kind`` is ``mirror_agreement``.

        Raises:
            InvalidGuides: the network's answer is no set of guides.
        """
        small = cv2.resize(grey, (self._width, self._height), interpolation=cv2.INTER_AREA).astype(np.float32)
        batch = np.ascontiguousarray(np.stack([small, small[:, ::-1]])[:, None])
        answer = self._session.run(None, {self._input.name: batch})[0]
        coefficients = np.asarray(answer, dtype=np.float64).reshape(2, 2, len(self._anchors), self._terms)
        direct, mirrored = coefficients[0], mirrored_coefficients(coefficients[1])
        along = np.vander(np.linspace(-0.9, 0.9, 7), self._terms, increasing=True)
        disagreement = float(np.sqrt(np.mean(((direct - mirrored) @ along.T) ** 2))) / 2
        rows, columns = (direct + mirrored) / 2
        return Estimate(
            guides=Guides(GuideFamily(self._anchors, rows), GuideFamily(self._anchors, columns)),
            confidence=1 / (1 + (disagreement / HALF_CONFIDENCE_WIDTHS) ** 2),
            confidence_kind="mirror_agreement",
            model=self._model,
        )


def mirrored_coefficients(coefficients: Float64) -> Float64:
    """Coefficients (2, K, degree + 1), rows then columns, of the picture mirrored left to right; centred frame.

    A row guide y(x) becomes y(-x); a column guide x(y) becomes -x(y), and the order of the columns turns round.
    """
    alternating = (-1.0) ** np.arange(coefficients.shape[-1])
    return np.stack([coefficients[0] * alternating, -coefficients[1][::-1]])
