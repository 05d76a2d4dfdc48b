"""Photographs of chessboards by real cameras, calibrated here for the truth (Debian's opencv-doc has a stereo pair)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from unbend_service.domain.cameras import Camera
from unbend_service.domain.errors import InvalidOption
from unbend_service.evaluation.cases import Bytes, Case

OPENCV_DOC = Path("/usr/share/doc/opencv-doc/examples/data")
INNER_CORNERS = (9, 6)
_CAMERAS = ("left", "right")
_NUMBERED = r"\d+\.(jpg|png)"
_FEWEST_VIEWS = 5
_BEST_RMS_PX = 1.0


def has_chessboards(folder: Path) -> bool:
    return any(_views(folder, name) for name in _CAMERAS)


def chessboard_cases(folder: Path) -> Iterator[Case]:
    """Every picture left01.jpg, right01.jpg and so on, with the calibration of its camera over all of them.

    Raises:
        InvalidOption: there are too few boards to calibrate a camera.
    """
    for name in _CAMERAS:
        pictures = [np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8) for path in _views(folder, name)]
        camera = calibrated(pictures)
        for picture in pictures:
            yield Case(f"chessboard-{name}", picture, camera)


def calibrated(pictures: list[Bytes]) -> Camera:
    """OpenCV's calibration, k1 k2 p1 p2 k3, over all views in which the whole board is found.

    Raises:
        InvalidOption: fewer than five such views, or no camera explains them.
    """
    board = np.zeros((INNER_CORNERS[0] * INNER_CORNERS[1], 3), np.float32)
    board[:, :2] = np.mgrid[0 : INNER_CORNERS[0], 0 : INNER_CORNERS[1]].T.reshape(-1, 2)
    refined = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
    corners = []
    for picture in pictures:
        found, seen = cv2.findChessboardCorners(picture, INNER_CORNERS)
        if found:
            corners.append(cv2.cornerSubPix(picture, seen, (5, 5), (-1, -1), refined))
    if len(corners) < _FEWEST_VIEWS:
        raise InvalidOption(
            f"{len(corners)} chessboards of {INNER_CORNERS[0]} x {INNER_CORNERS[1]} inner corners are found.",
            allowed=f"{_FEWEST_VIEWS} or more views of one camera",
        )
    height, width = pictures[0].shape
    rms_px, matrix, coefficients, _, _ = cv2.calibrateCamera(
        [board] * len(corners), corners, (width, height), np.eye(3), np.zeros(5)
    )
    if rms_px > _BEST_RMS_PX:
        raise InvalidOption(f"The chessboards are explained to {rms_px:.1f} px only.", allowed=f"{_BEST_RMS_PX} px")
    return Camera(np.asarray(matrix), tuple(map(float, np.ravel(coefficients)[:5])), False, width, height)


def _views(folder: Path, name: str) -> list[Path]:
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if re.fullmatch(name + _NUMBERED, path.name))
