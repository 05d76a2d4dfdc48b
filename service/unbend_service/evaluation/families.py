"""The six distortion families of LZSL19 (Li, Zhang, Sander and Liao, "Blind Geometric Distortion Correction on Images
Through Deep Learning", 2019), none, and a mixture: maps of a 256 crop out of the middle of a 512 photograph.

Each is given from the distorted picture to the straight one, in pixels of the photograph, and drawn in the order and
from the seeds of the evaluation over the public API, so that figures can be compared.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import cv2
import numpy as np

from unbend_service.evaluation.cases import Bytes, Case, Float64, Photograph, grey_of

FULL_PX, CROP_PX = 512, 256
FAMILIES = ("barrel", "pincushion", "rotation", "shear", "projective", "wave", "none", "mixed")
SIX = FAMILIES[:6]
BENT = ("barrel", "pincushion", "wave", "mixed")
"""The families of which no homography is the cure."""
TABLE_ONE_PICTURES = 100
_TABLE_ONE_SEED = 1
_CENTRE = FULL_PX / 2
_CORNER = (FULL_PX - CROP_PX) / 2
_STEPS = 40
_STEP_PX = 1e-3
_NEAR_PX = 1e-4
_LONGEST_MOVE_PX = 40

#: (n, 2) pixels of the distorted picture -> (n, 2) pixels of the straight one, pixel centres at whole numbers.
PixelMap = Callable[[Float64], Float64]


def family_cases(family: str, photographs: list[Photograph]) -> Iterator[Case]:
    """Each photograph under a random distortion of the family."""
    rng = np.random.default_rng(sum(map(ord, family)))
    for photograph in photographs:
        yield distorted_case(family, grey_square(photograph.pixels), draw(family, rng), photograph.source)


def table_one_cases(photographs: list[Photograph]) -> Iterator[Case]:
    """A hundred photographs, the six families in turn: one average over all, as in the paper's first table."""
    rng = np.random.default_rng(_TABLE_ONE_SEED)
    for number, photograph in enumerate(photographs[:TABLE_ONE_PICTURES]):
        family = SIX[number % len(SIX)]
        yield distorted_case(family, grey_square(photograph.pixels), draw(family, rng), photograph.source)


def distorted_case(group: str, square: Bytes, straighten: PixelMap, source: str = "") -> Case:
    """A grey 512 x 512 photograph, its middle seen through a distortion."""
    at = np.arange(CROP_PX) + _CORNER
    pixels = np.stack(np.meshgrid(at, at), -1).reshape(-1, 2)
    straight = straighten(pixels).reshape(CROP_PX, CROP_PX, 2).astype(np.float32)
    picture = cv2.remap(square, straight[..., 0], straight[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    corner = int(_CORNER)
    original = square[corner : corner + CROP_PX, corner : corner + CROP_PX]
    return Case(group, np.asarray(picture, np.uint8), lambda target: bent(straighten, target), original, source)


def grey_square(pixels: Bytes) -> Bytes:
    """The middle square of a photograph, 512 x 512, grey."""
    height, width = pixels.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    square = pixels[top : top + side, left : left + side]
    return grey_of(np.asarray(cv2.resize(square, (FULL_PX, FULL_PX), interpolation=cv2.INTER_AREA), np.uint8))


def draw(family: str, rng: np.random.Generator) -> PixelMap:
    """A random member of a family."""
    if family == "none":
        return lambda pixels: pixels
    if family == "barrel":
        return division(-rng.random() * 5e-5 / 4)
    if family == "pincushion":
        return division(rng.random() * 8.6e-5 / 4)
    if family == "rotation":
        return rotation(rng.uniform(-15, 15))
    if family == "shear":
        return shear(rng.uniform(-0.4, 0.4))
    if family == "projective":
        return trapezoid(rng.uniform(0.1, 0.2))
    if family == "wave":
        return wave(rng.uniform(0, 32))
    if family == "mixed":
        parts = (division(rng.uniform(-1.25e-5, 1.2e-5)), rotation(rng.uniform(-8, 8)), trapezoid(rng.uniform(0, 0.1)))
        return lambda pixels: parts[2](parts[1](parts[0](pixels)))
    raise ValueError(f"There is no family {family!r}.")


def division(strength: float) -> PixelMap:
    """One-parameter division model about the middle, per square pixel."""

    def straighten(pixels: Float64) -> Float64:
        offset = pixels - _CENTRE
        return np.asarray(offset / (1 + strength * (offset**2).sum(1, keepdims=True)) + _CENTRE)

    return straighten


def rotation(degrees: float) -> PixelMap:
    angle = math.radians(degrees)
    turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    return lambda pixels: np.asarray((pixels - _CENTRE) @ turn.T + _CENTRE)


def shear(slope: float) -> PixelMap:
    return lambda pixels: np.asarray(pixels + slope * (pixels[:, 1:] - _CENTRE) * np.array([1.0, 0.0]))


def wave(magnitude_px: float) -> PixelMap:
    def straighten(pixels: Float64) -> Float64:
        sideways = magnitude_px * np.sin(4 * np.pi * pixels[:, 1] / FULL_PX)
        return pixels + np.stack([sideways, np.zeros_like(sideways)], 1)

    return straighten


def trapezoid(inset: float) -> PixelMap:
    """The crop's square onto a trapezoid whose bottom corners are moved in by `inset` of its width."""
    edge = CROP_PX - 1.0
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32)
    shape = np.array([(0, 0.005), (1, 0.005), (1 - inset, 0.995), (inset, 0.995)], np.float32)
    matrix = cv2.getPerspectiveTransform(square, shape).astype(np.float64)

    def straighten(pixels: Float64) -> Float64:
        unit = (pixels - _CORNER) / edge
        projected = unit @ matrix[:, :2].T + matrix[:, 2]
        return np.asarray(projected[:, :2] / projected[:, 2:] * edge + _CORNER)

    return straighten


def bent(straighten: PixelMap, target: Float64) -> Float64:
    """(..., 2) centred target points of the crop -> centred source points, NaN where there is none: Newton's method."""
    wanted = (target.reshape(-1, 2) + 1) / 2 * CROP_PX - 0.5 + _CORNER
    found = wanted.copy()
    away = np.arange(len(wanted))
    for _ in range(_STEPS):
        here = straighten(found[away])
        missed = wanted[away] - here
        still = np.abs(missed).max(1) >= _NEAR_PX
        away, here, missed = away[still], here[still], missed[still]
        if not len(away):
            break
        at = found[away]
        by_x, by_y = ((straighten(at + offset) - here) / _STEP_PX for offset in np.eye(2) * _STEP_PX)
        determinant = by_x[:, 0] * by_y[:, 1] - by_x[:, 1] * by_y[:, 0]
        determinant = np.where(np.abs(determinant) < 1e-6, 1e-6, determinant)
        across = (by_y[:, 1] * missed[:, 0] - by_y[:, 0] * missed[:, 1]) / determinant
        down = (by_x[:, 0] * missed[:, 1] - by_x[:, 1] * missed[:, 0]) / determinant
        length = np.maximum(np.hypot(across, down), 1e-12)
        found[away] = at + np.stack([across, down], 1) * np.minimum(1, _LONGEST_MOVE_PX / length)[:, None]
    lost = np.hypot(*(straighten(found) - wanted).T) > 1e-2
    source = (found - _CORNER + 0.5) / CROP_PX * 2 - 1
    source[lost] = np.nan
    return np.asarray(source.reshape(target.shape))
