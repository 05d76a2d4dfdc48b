"""The pictures that estimators are measured on: validation photographs under known distortions.

The LZSL19 families, `none` and `mixed` are those of the evaluation over the public API, drawn in the same order
from the same seeds, so that figures can be compared; `brown` and `fisheye` are lenses beyond them.
"""

from __future__ import annotations

import csv
import hashlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from training.distortions import DistortionBatch
from training.homographies import LZSL_CENTRE
from training.random_distortions import KINDS, draw_distortions, fixed_distortion

Float64 = npt.NDArray[np.float64]
Bytes = npt.NDArray[np.uint8]

FAMILIES = ("barrel", "pincushion", "rotation", "shear", "projective", "wave", "none", "mixed", "brown", "fisheye")
LZSL_SIX = FAMILIES[:6]
FULL_PX, CROP_PX = 512, 256
_RADIUS_UNIT = 128.0**2
"""Square of the pixels per isotropic unit: LZSL19 gives its division parameter per square pixel."""


@dataclass(frozen=True)
class Case:
    """A distorted picture, uint8 (256, 256), and the distortion (a batch of one) that made it."""

    picture: Bytes
    distortion: DistortionBatch


def photographs(folder: Path, split: str, limit: int) -> list[Bytes]:
    """Colour photographs of a split (val, train) in the order of the public evaluation: by the hash of their path."""
    with open(folder / "index.csv", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["split"] == split]
    rows.sort(key=lambda row: hashlib.sha256(row["path"].encode()).hexdigest())
    return [np.asarray(cv2.imread(str(folder / row["path"])), np.uint8) for row in rows[:limit]]


def cases(family: str, pictures: list[Bytes], seed: int | None = None) -> Iterator[Case]:
    """Each photograph under a random distortion of the family; without a seed, those of the public evaluation."""
    public = sum(map(ord, family))
    generator = np.random.default_rng(public if seed is None else [public, seed])
    for photograph in pictures:
        distortion = draw_family(family, generator)
        yield Case(distorted(_centre_square(photograph), distortion), distortion)


def draw_family(family: str, rng: np.random.Generator) -> DistortionBatch:
    """A batch of one."""
    if family in ("brown", "fisheye"):
        return draw_distortions(1, rng, np.array([KINDS.index(family)]))
    if family == "barrel":
        return fixed_distortion(division=-rng.random() * 5e-5 / 4 * _RADIUS_UNIT)
    if family == "pincushion":
        return fixed_distortion(division=rng.random() * 8.6e-5 / 4 * _RADIUS_UNIT)
    if family == "rotation":
        return fixed_distortion(degrees=rng.uniform(-15, 15))
    if family == "shear":
        return fixed_distortion(shear=rng.uniform(-0.4, 0.4))
    if family == "projective":
        return fixed_distortion(inset=rng.uniform(0.1, 0.2))
    if family == "wave":
        return fixed_distortion(wave=(rng.uniform(0, 32) / 128, -math.pi * LZSL_CENTRE))
    if family == "mixed":
        return fixed_distortion(
            division=rng.uniform(-1.25e-5, 1.2e-5) * _RADIUS_UNIT,
            degrees=rng.uniform(-8, 8),
            inset=rng.uniform(0.0, 0.1),
        )
    if family == "none":
        return fixed_distortion()
    raise ValueError(f"There is no family {family!r}.")


def distorted(square: Bytes, distortion: DistortionBatch) -> Bytes:
    """Grey uint8 (256, 256) crop of a 512x512 photograph seen through the distortion."""
    centres = (2 * np.arange(CROP_PX) + 1) / CROP_PX - 1
    x, y = (a.reshape(1, -1) for a in np.meshgrid(centres, centres))
    target_x, target_y = distortion.straighten(x, y)
    map_x, map_y = (
        (a.clip(-8, 8).reshape(CROP_PX, CROP_PX) * 128 + FULL_PX / 2 - 0.5).astype(np.float32)
        for a in (target_x, target_y)
    )
    crop = cv2.remap(square, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    return np.asarray(cv2.cvtColor(crop, cv2.COLOR_BGR2GRAY), np.uint8)


def _centre_square(photograph: Bytes) -> Bytes:
    height, width = photograph.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    square = photograph[top : top + side, left : left + side]
    return np.asarray(cv2.resize(square, (FULL_PX, FULL_PX), interpolation=cv2.INTER_AREA), np.uint8)
