"""Where the sixteen nodes of the paper's network start: ridge regression on what the untrained convolutions see.

In its dual form, because a picture has 25,088 features and pictures are fewer. Channels are brought to one scale first;
the pull towards the mean answer is chosen on the last tenth of the training pictures.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]

RIDGES = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0)
"""Tried in units of the mean diagonal of the Gram matrix."""
_CHANNELS = 512
_LEAST_SCALE = 0.05
_LARGEST_SAMPLE = 8192


@dataclass(frozen=True)
class Regression:
    """answers = features @ weight.T + bias.

    Attributes:
        weight: float32 (outputs, features). bias: float32 (outputs,).
        ridge: that was chosen.
        errors: mean squared error on the pictures held back, by ridge; `constant_error` is that of the mean answer.
    """

    weight: Float32
    bias: Float32
    ridge: float
    errors: dict[float, float]
    constant_error: float


def regress(features: Float32, wanted: Float64) -> Regression:
    """features: (n, 512 * positions), channel by channel. wanted: (n, outputs)."""
    features, wanted = features[:_LARGEST_SAMPLE], wanted[:_LARGEST_SAMPLE]
    centre = features.mean(0)
    spread = (features - centre).reshape(len(features), _CHANNELS, -1).std((0, 2))
    scale = np.repeat(1 / np.maximum(spread, _LEAST_SCALE), features.shape[1] // _CHANNELS).astype(np.float32)
    standardised = (features - centre) * scale
    gram = (standardised @ standardised.T).astype(np.float64)
    unit = float(np.trace(gram)) / len(gram)
    kept = np.arange(len(features)) < len(features) * 9 // 10
    mean = wanted[kept].mean(0)
    errors = {}
    for ridge in RIDGES:
        dual = _solve(gram[np.ix_(kept, kept)], wanted[kept] - mean, ridge * unit)
        errors[ridge] = float(((gram[np.ix_(~kept, kept)] @ dual + mean - wanted[~kept]) ** 2).mean())
    ridge = min(errors, key=lambda one: errors[one])
    mean_of_all = wanted.mean(0)
    dual = _solve(gram, wanted - mean_of_all, ridge * unit)
    weight = (dual.T.astype(np.float32) @ standardised) * scale
    return Regression(
        weight=weight,
        bias=(mean_of_all - weight @ centre).astype(np.float32),
        ridge=ridge,
        errors=errors,
        constant_error=float(((mean - wanted[~kept]) ** 2).mean()),
    )


def _solve(gram: Float64, wanted: Float64, ridge: float) -> Float64:
    return np.asarray(np.linalg.solve(gram + ridge * np.eye(len(gram)), wanted))
