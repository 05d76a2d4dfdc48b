from __future__ import annotations

import cv2
import numpy as np
import pytest

from unbend_service.domain.cameras import Camera
from unbend_service.domain.dense_maps import pixel_maps
from unbend_service.domain.errors import InvalidGrid

K = np.array([[410.0, 0, 331], [0, 405.0, 236], [0, 0, 1]])


@pytest.mark.parametrize(
    "coefficients",
    [
        (-0.28, 0.07, 0.0012, -0.0021),
        (-0.28, 0.07, 0.0012, -0.0021, 0.011),
        (0.1, 0.02, 0.001, 0.0, 0.003, 0.2, 0.05, 0.01),
        (-0.2, 0.04, 0.0, 0.001, 0.0, 0.01, 0.0, 0.0, 0.002, -0.001, 0.003, 0.001),
        (-0.2, 0.04, 0.0, 0.001, 0.0, 0.01, 0.0, 0.0, 0.002, -0.001, 0.003, 0.001, 0.0, 0.0),
    ],
    ids=len,
)
def test_a_pinhole_camera_is_the_one_of_opencv(coefficients: tuple[float, ...]) -> None:
    """The maps are those of cv2.initUndistortRectifyMap, for every number of coefficients that OpenCV writes."""
    maps = pixel_maps(Camera(K, coefficients, False, 640, 480), 640, 480)
    expected = cv2.initUndistortRectifyMap(K, np.array(coefficients), None, K, (640, 480), cv2.CV_32FC1)
    for ours, theirs in zip(maps, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=2e-3)


def test_a_fisheye_camera_is_the_one_of_opencv() -> None:
    """The maps are those of cv2.fisheye.initUndistortRectifyMap."""
    coefficients = (-0.02, 0.008, -0.004, 0.0005)
    maps = pixel_maps(Camera(K, coefficients, True, 640, 480), 640, 480)
    expected = cv2.fisheye.initUndistortRectifyMap(K, np.array(coefficients), np.eye(3), K, (640, 480), cv2.CV_32FC1)
    for ours, theirs in zip(maps, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=2e-3)


@pytest.mark.parametrize(
    ("matrix", "coefficients", "fisheye"),
    [
        (np.zeros((3, 3)), (0.0,) * 4, False),
        (np.full((3, 3), np.nan), (0.0,) * 4, False),
        (K, (0.0,) * 6, False),
        (K, (0.0,) * 5, True),
        (K, (float("nan"),) * 4, False),
        (K, (*(0.0,) * 12, 0.1, 0.0), False),
    ],
)
def test_what_is_no_camera_is_refused(matrix: np.ndarray, coefficients: tuple[float, ...], fisheye: bool) -> None:
    with pytest.raises(InvalidGrid):
        Camera(matrix, coefficients, fisheye, 640, 480)
