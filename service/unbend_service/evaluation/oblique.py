"""Oblique views: the same bent pictures twice, once of an upright scene and once of one seen at an angle.

A camera that is turned to the side, up or down, or held askew sees a straight scene through a homography; parallels
converge, verticals lean, and no line is bent. A model that takes such a pose for distortion does worse on it. Each
picture of the oblique half has its twin in the upright half: the same photograph and the same lens.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import cv2
import numpy as np

from unbend_service.evaluation.cases import Bytes, Case, Float64, Photograph
from unbend_service.evaluation.families import BENT, FULL_PX, distorted_case, draw, grey_square

UPRIGHT, OBLIQUE = "upright", "oblique"
SEED = 31
FOCAL_SIDES = 0.9
"""Focal length of the turned camera, in sides of the photograph: 58 degrees across."""
_YAW_DEGREES = (12.0, 28.0)
_PITCH_DEGREES = (0.0, 16.0)
_ROLL_DEGREES = 8.0


def oblique_cases(photographs: list[Photograph], families: tuple[str, ...] = BENT) -> Iterator[Case]:
    """Groups `upright barrel`, `oblique barrel` and so on; nothing bent is among them but by the lens."""
    for family in (*families, "none"):
        rng = np.random.default_rng([SEED, sum(map(ord, family))])
        for photograph in photographs:
            square = grey_square(photograph.pixels)
            lens = draw(family, rng)
            yield distorted_case(f"{UPRIGHT} {family}", square, lens)
            yield distorted_case(f"{OBLIQUE} {family}", seen_askew(square, rng), lens)


def seen_askew(square: Bytes, rng: np.random.Generator) -> Bytes:
    """A grey photograph, 512 x 512, as a camera turned by a random yaw, pitch and roll sees it, filling the frame."""
    yaw, pitch = (math.radians(rng.uniform(*span) * rng.choice((-1, 1))) for span in (_YAW_DEGREES, _PITCH_DEGREES))
    turned = _turned(yaw, pitch, math.radians(rng.uniform(-_ROLL_DEGREES, _ROLL_DEGREES)))
    corners = np.array([(0, 0), (FULL_PX, 0), (FULL_PX, FULL_PX), (0, FULL_PX)], np.float64)
    inside = _fill(turned, corners)
    return np.asarray(
        cv2.warpPerspective(
            square,
            inside,
            (FULL_PX, FULL_PX),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REFLECT_101,
        ),
        np.uint8,
    )


def _turned(yaw: float, pitch: float, roll: float) -> Float64:
    """Homography from the turned camera's picture to the photograph, pixels."""
    focal = FOCAL_SIDES * FULL_PX
    camera = np.array([[focal, 0, FULL_PX / 2], [0, focal, FULL_PX / 2], [0, 0, 1]])
    about_y = np.array([[math.cos(yaw), 0, math.sin(yaw)], [0, 1, 0], [-math.sin(yaw), 0, math.cos(yaw)]])
    about_x = np.array([[1, 0, 0], [0, math.cos(pitch), -math.sin(pitch)], [0, math.sin(pitch), math.cos(pitch)]])
    about_z = np.array([[math.cos(roll), -math.sin(roll), 0], [math.sin(roll), math.cos(roll), 0], [0, 0, 1]])
    return np.asarray(camera @ about_y @ about_x @ about_z @ np.linalg.inv(camera))


def _fill(turned: Float64, corners: Float64) -> Float64:
    """The same view, moved and scaled in the photograph's plane so that its outline just fits into the photograph."""
    projected = np.concatenate([corners, np.ones((4, 1))], 1) @ turned.T
    outline = projected[:, :2] / projected[:, 2:]
    low, high = outline.min(0), outline.max(0)
    scale = FULL_PX / (high - low).max()
    shift = FULL_PX / 2 - scale * (low + high) / 2
    place = np.array([[scale, 0, shift[0]], [0, scale, shift[1]], [0, 0, 1]])
    return np.asarray(place @ turned)
