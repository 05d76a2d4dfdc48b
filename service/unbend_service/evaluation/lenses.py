"""Lenses that no model was trained on: OpenCV's rational, thin prism and fisheye (KB4) camera models.

A fixed set of cameras, drawn once from ranges that calibrations of real cameras span, from phone to action camera and
wide fisheye; and cameras without distortion. Photographs are seen through them as by an ideal camera in front of the
photograph, at a focal length that lets the photograph fill the distorted picture.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from unbend_service.domain.cameras import Camera
from unbend_service.domain.maps import pixel_centres
from unbend_service.evaluation.cases import Bytes, Case, Float64, Photograph, grey_of

LONG_SIDE_PX = 384
SEED = 20
CAMERAS_PER_MODEL = 4
STRAIGHT_CAMERAS = 2
_MODELS = ("rational", "thin-prism", "fisheye")
_INVERSION_TOLERANCE = 1e-5
_STEEPEST = 40


def cameras() -> dict[str, Camera]:
    """Name -> camera of a 4:3 picture, always the same ones."""
    rng = np.random.default_rng(SEED)
    named = {}
    for model in _MODELS:
        for number in range(1, CAMERAS_PER_MODEL + 1):
            named[f"{model}-{number}"] = _draw(model, rng)
    for number in range(1, STRAIGHT_CAMERAS + 1):
        named[f"straight-{number}"] = _camera(rng.uniform(45, 75), (0.0,) * 5, False, rng)
    return named


def is_straight(name: str) -> bool:
    """Whether a camera of :func:`cameras` has no distortion."""
    return name.startswith("straight")


def lens_cases(photographs: list[Photograph], per_camera: int) -> Iterator[Case]:
    """Every camera with `per_camera` of the photographs, which are dealt out in turn."""
    for index, (name, camera) in enumerate(cameras().items()):
        for turn in range(per_camera):
            photograph = photographs[(index * per_camera + turn) % len(photographs)]
            yield photographed(name, camera, photograph)


def photographed(name: str, camera: Camera, photograph: Photograph) -> Case:
    """The photograph, cut to 4:3, as this camera sees it."""
    grey = _cut(grey_of(photograph.pixels), camera.width / camera.height)
    x, y = np.meshgrid(pixel_centres(camera.width), pixel_centres(camera.height))
    target = undistorted(camera, np.stack([x, y], -1).reshape(-1, 2)).reshape(camera.height, camera.width, 2)
    # The photograph lies in the target plane, just large enough to be all that the camera sees.
    span = np.abs(target).max()
    height, width = grey.shape
    map_x = ((target[..., 0] / span + 1) / 2 * width - 0.5).astype(np.float32)
    map_y = ((target[..., 1] / span + 1) / 2 * height - 0.5).astype(np.float32)
    shrink = width / (camera.width * span)
    if shrink > 1:
        grey = np.asarray(cv2.GaussianBlur(grey, (0, 0), 0.4 * shrink), np.uint8)
    picture = cv2.remap(grey, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    return Case(name, np.asarray(picture, np.uint8), camera)


def undistorted(camera: Camera, source: Float64) -> Float64:
    """(n, 2) target points of source points, centred: damped Newton steps on the camera's own map.

    Raises:
        ArithmeticError: the model folds inside the picture.
    """
    target, step = source.copy(), 1e-5
    for _ in range(_STEEPEST):
        here = camera(target)
        missed = source - here
        if np.abs(missed).max() < _INVERSION_TOLERANCE:
            return target
        by_s, by_t = ((camera(target + offset) - here) / step for offset in np.eye(2) * step)
        determinant = by_s[:, 0] * by_t[:, 1] - by_s[:, 1] * by_t[:, 0]
        if (determinant < 1e-3).any():
            break
        move = (
            np.stack(
                [
                    by_t[:, 1] * missed[:, 0] - by_t[:, 0] * missed[:, 1],
                    by_s[:, 0] * missed[:, 1] - by_s[:, 1] * missed[:, 0],
                ],
                1,
            )
            / determinant[:, None]
        )
        length = np.hypot(*move.T)[:, None]
        target = target + move * np.minimum(1, 0.3 / np.maximum(length, 1e-12))
    raise ArithmeticError("The camera model cannot be inverted inside its picture.")


def _draw(model: str, rng: np.random.Generator) -> Camera:
    """Until one comes whose model holds over its whole picture."""
    while True:
        camera = _drawn(model, rng)
        border = np.linspace(-1, 1, 41)
        edge = np.concatenate([np.stack(np.broadcast_arrays(border, side), 1) for side in (-1.0, 1.0)])
        try:
            undistorted(camera, np.concatenate([edge, edge[:, ::-1]]))
        except ArithmeticError:
            continue
        return camera


def _drawn(model: str, rng: np.random.Generator) -> Camera:
    uniform = rng.uniform
    if model == "fisheye":
        # Focal lengths of 60 to 110 degrees across; the polynomial as calibrations of action cameras have it.
        coefficients = (uniform(-0.06, 0.06), uniform(-0.03, 0.03), uniform(-0.015, 0.015), uniform(-0.005, 0.005))
        return _camera(uniform(60, 110), coefficients, True, rng)
    if model == "thin-prism":
        k1 = uniform(-0.35, 0.08)
        radial = (k1, uniform(0.05, 0.35) * k1 * k1 + uniform(-0.02, 0.06))
        tangential = tuple(rng.normal(0, 0.0015, 2))
        prism = tuple(rng.normal(0, 0.006, 4) * (1, 0.3, 1, 0.3))
        return _camera(uniform(55, 85), (*radial, *tangential, uniform(-0.02, 0.02), 0, 0, 0, *prism), False, rng)
    k4, k5, k6 = uniform(-0.1, 0.5), uniform(-0.05, 0.1), uniform(-0.01, 0.02)
    bend = uniform(-0.3, 0.06)
    numerator = (k4 + bend, k5 + bend * k4 + uniform(-0.05, 0.05), k6 + uniform(-0.01, 0.01))
    tangential = tuple(rng.normal(0, 0.001, 2))
    coefficients = (numerator[0], numerator[1], *tangential, numerator[2], k4, k5, k6)
    return _camera(uniform(55, 90), coefficients, False, rng)


def _camera(across_degrees: float, coefficients: tuple[float, ...], fisheye: bool, rng: np.random.Generator) -> Camera:
    """With the angle that its width spans along the axis, and its principal point a little off the middle."""
    width, height = LONG_SIDE_PX, LONG_SIDE_PX * 3 // 4
    half_angle = np.radians(across_degrees) / 2
    focal = width / 2 / (half_angle if fisheye else np.tan(half_angle))
    centre = np.array([width, height]) / 2 + rng.normal(0, 0.01, 2) * width
    matrix = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1.0]])
    return Camera(matrix, tuple(float(c) for c in coefficients), fisheye, width, height)


def _cut(grey: Bytes, aspect: float) -> Bytes:
    """The middle of the aspect; a photograph in portrait is turned on its side's middle likewise."""
    height, width = grey.shape
    wide, high = min(width, int(height * aspect)), min(height, int(width / aspect))
    left, top = (width - wide) // 2, (height - high) // 2
    return grey[top : top + high, left : left + wide]
