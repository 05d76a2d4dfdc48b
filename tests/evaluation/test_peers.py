"""The classical plumb-line that the tables compare with."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from unbend_service.adapters.estimators.chains import extract
from unbend_service.adapters.estimators.radial_family import straighten
from unbend_service.evaluation.peers import PlumblinePeer, straightest_division


def _lines_through(division: float) -> npt.NDArray[np.uint8]:
    """A 256 picture of an evenly striped plane, seen through a centred division lens."""
    centres = (2 * np.arange(256) + 1) / 256 - 1
    x, y = np.meshgrid(centres, centres)
    target = straighten(np.array([division, 0, 0, 0]), np.stack([x.ravel(), y.ravel()], 1))
    waves = np.clip(20 * np.sin(9 * target[:, 0] + 2 * target[:, 1] + 0.5), -1, 1)
    picture = np.uint8(120 + 70 * waves.reshape(256, 256))
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.6), np.uint8)


@pytest.mark.parametrize("division", [-0.15, 0.0, 0.2])
def test_the_lens_of_a_striped_plane_is_found(division: float) -> None:
    """Where every edge is straight the peer is as good as a calibration."""
    assert straightest_division(extract(_lines_through(division))) == pytest.approx(division, abs=0.006)


def test_a_picture_without_edges_is_left_alone() -> None:
    """No chains, no lens."""
    assert PlumblinePeer().examine(np.full((256, 256), 90, np.uint8)).is_straight
