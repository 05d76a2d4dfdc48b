"""The confidence: a logistic regression that turns what speaks for an estimate into the probability that the picture,
its nonlinear part corrected, is nearer to straight than it was.

Fitted on training photographs under fresh distortions, so that the validation photographs remain to check it on; and
on whole ones as they are, which must not be moved. Those have mild lenses of their own, and straightening them would do
no harm; but nobody asked for it, so a mild distortion is believed only when much speaks for it.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from training.evaluation import WHOLE, Measurement, measure, measure_whole
from training.protocol import Bytes, photographs
from unbend_service.adapters.estimators.lineset import LinesetEstimator

Float64 = npt.NDArray[np.float64]

FAMILIES = ("none", "rotation", "projective", "barrel", "pincushion", "wave", "mixed", "brown", "fisheye")
SEED = 20
WHOLE_SHARE = 4
"""Whole photographs for each one that is distorted."""
TEXTURE = "texture"
"""Family of pictures of nothing."""
WEIGHTS = {WHOLE: 2.0, TEXTURE: 0.4}
"""Of a picture of a family, 1 for the others. Textures with a weight of 2 cost a fifth of the corrected waves."""
_RIDGE = 1e-2
_BINS = np.array([0.0, 0.05, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95, 0.98, 1.0])


@dataclass(frozen=True)
class Calibration:
    """weights: of `Evidence.inputs`. reliability: rows of (predicted, observed, pictures)."""

    weights: tuple[float, ...]
    reliability: list[tuple[float, float, int]]


def gather(estimator: LinesetEstimator, folder: Path, limit: int) -> list[Measurement]:
    """Measurements on training photographs."""
    distorted = measure(estimator, photographs(folder, "train", limit), FAMILIES, seed=SEED)
    whole = measure_whole(estimator, photographs(folder, "train", WHOLE_SHARE * limit))
    nothing = [replace(m, family=TEXTURE) for m in measure_whole(estimator, list(_textures(limit)))]
    return distorted + whole + nothing


def _textures(count: int) -> Iterator[Bytes]:
    """Colour pictures of nothing: noise of all grains, as of foliage, water and cloth."""
    rng = np.random.default_rng(SEED)
    for _ in range(count):
        height, width = int(rng.integers(280, 512)), int(rng.integers(280, 512))
        noise = rng.standard_normal((height, width)).astype(np.float32)
        grain = float(np.exp(rng.uniform(np.log(1.0), np.log(12.0))))
        stretched = cv2.GaussianBlur(noise, (0, 0), grain * float(rng.uniform(0.6, 1.6)), sigmaY=grain)
        grey = (128 + 60 * stretched / stretched.std()).clip(0, 255).astype(np.uint8)
        yield np.repeat(grey[..., None], 3, axis=2)


def calibrate(measurements: list[Measurement]) -> Calibration:
    """Fits the weights by Newton's method on the penalised likelihood."""
    known = [m for m in measurements if m.evidence is not None]
    inputs = np.array([m.evidence.inputs() for m in known if m.evidence is not None])
    better = np.array([m.nonlinear < m.nonlinear_nothing for m in known], np.float64)
    weight = np.array([WEIGHTS.get(m.family, 1.0) for m in known])
    weights = np.zeros(inputs.shape[1])
    for _ in range(50):
        probability = probabilities(inputs, weights)
        gradient = inputs.T @ (weight * (probability - better)) + _RIDGE * weights
        curvature = (inputs * (weight * probability * (1 - probability))[:, None]).T @ inputs
        curvature += _RIDGE * np.eye(len(weights))
        step = np.linalg.solve(curvature, gradient)
        weights = weights - step
        if np.abs(step).max() < 1e-8:
            break
    return Calibration(tuple(weights.tolist()), reliability(probabilities(inputs, weights), better))


def probabilities(inputs: Float64, weights: Float64) -> Float64:
    """(n,) of inputs (n, k)."""
    return np.asarray(1 / (1 + np.exp(-np.clip(inputs @ weights, -30, 30))))


def reliability(predicted: Float64, better: Float64) -> list[tuple[float, float, int]]:
    """Mean predicted probability, observed share and number of pictures of each bin that is not empty."""
    rows = []
    for low, high in itertools.pairwise(_BINS):
        inside = (predicted >= low) & ((predicted < high) | (high == 1.0))
        if inside.any():
            rows.append((float(predicted[inside].mean()), float(better[inside].mean()), int(inside.sum())))
    return rows


def reliability_table(rows: list[tuple[float, float, int]]) -> str:
    """Markdown."""
    lines = ["| confidence | better in | pictures |", "|---|---|---|"]
    return "\n".join(lines + [f"| {predicted:.2f} | {observed:.2f} | {count} |" for predicted, observed, count in rows])
