"""Estimators, and what they say."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from unbend_service.domain.decision import TRUSTING, Caution
from unbend_service.domain.frames import Bytes
from unbend_service.domain.guides import Guides


@dataclass(frozen=True, slots=True)
class ModelInfo:
    """Which network answered.

    Attributes:
        name: short name, as the setting ``model`` takes it.
        sha256: of the weight file, lower-case hex.
        caution: that its card advises for a picture's lens.
    """

    name: str
    sha256: str
    caution: Caution = TRUSTING


@dataclass(frozen=True, slots=True)
class Estimate:
    """What an estimator says of one picture.

    Attributes:
        guides: estimated guides, centred coordinates.
        confidence: 0..1; what it means is said by ``confidence_kind``.
        confidence_kind: ``mirror_agreement`` or ``calibrated_probability``.
        expected_error: expected mean error of the nonlinear part in half picture widths, None if the model has no say.
        model: which network answered.
    """

    guides: Guides
    confidence: float
    confidence_kind: str
    model: ModelInfo
    expected_error: float | None = None


class Estimator(Protocol):
    """Looks at one picture. Thread-safe; blocking (the use case runs it off the event loop)."""

    @property
    def model(self) -> ModelInfo: ...

    def estimate(self, grey: Bytes) -> Estimate:
        """(height, width) uint8 grey, any size, upright -> Estimate."""
        ...
