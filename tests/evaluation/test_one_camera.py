from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.fakes import FAKE_MODEL
from training.scenes import draw_scene
from unbend_service.application.ports import Bytes, Estimate, ModelInfo
from unbend_service.domain.guides import GuideFamily, Guides
from unbend_service.evaluation.cases import Photograph
from unbend_service.evaluation.methods import model_method
from unbend_service.evaluation.one_camera import CAMERAS, PICTURES, camera_rows, camera_table
from unbend_service.evaluation.suites import ONE_CAMERA, run_suite


class NoisyEstimator:
    """Straight guides, each time bent another way."""

    def __init__(self) -> None:
        self._rng = np.random.default_rng(1)

    @property
    def model(self) -> ModelInfo:
        return FAKE_MODEL

    def estimate(self, grey: Bytes) -> Estimate:
        families = []
        for _ in range(2):
            straight = GuideFamily.straight(degree=3)
            bend = self._rng.normal(0, 0.03, straight.coefficients.shape) * (np.arange(4) > 1)
            families.append(GuideFamily(straight.anchors, straight.coefficients + bend))
        return Estimate(Guides(*families), 0.9, "calibrated_probability", FAKE_MODEL, 0.02)


def test_the_fused_answer_of_each_camera_stands_beside_its_single_ones() -> None:
    """Noise that differs from picture to picture averages out, and the table says by how much."""
    photographs = [Photograph(_colour(seed), "drawn", Path(f"{seed}.png")) for seed in range(PICTURES)]

    found = run_suite(ONE_CAMERA, [model_method(NoisyEstimator())], photographs)["fake"]

    rows = camera_rows(found)
    assert len(rows) == CAMERAS
    assert len(found) == CAMERAS * (PICTURES + 1)
    _, _, alone, fused = zip(*rows, strict=True)
    assert np.mean(fused) < np.mean(alone)
    assert camera_table(found).count("\n") == CAMERAS + 3


def _colour(seed: int) -> Bytes:
    return np.repeat(draw_scene(np.random.default_rng(seed))[..., None], 3, axis=2)
