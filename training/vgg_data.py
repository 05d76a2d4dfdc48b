"""Training pictures of the paper's network: photographs under known distortions, and photographs with annotations.

A sample is a grey picture, uint8 (224, 224), and the 16 coefficients of its guides (`coefficients`), centred frame.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from training.annotations import Annotation
from training.protocol import FULL_PX, distorted
from training.random_distortions import KINDS, draw_distortions
from training.vgg_network import SIDE_PX
from unbend_service.domain.fitting import fit_guides
from unbend_service.domain.guides import Guides
from unbend_service.domain.maps import target_lattice

Float64 = npt.NDArray[np.float64]
Bytes = npt.NDArray[np.uint8]
Sample = tuple[Bytes, Float64]

ANCHORS = (-0.6, 0.6)
"""Where the guides of every sample lie once straight. Two guides are blended linearly, so any other pair says the same;
one pair for all is what makes sixteen numbers of them."""
DEGREE = 3
SHARES = {
    "identity": 0.08,
    "barrel": 0.14,
    "pincushion": 0.15,
    "rotation": 0.1,
    "shear": 0.1,
    "projective": 0.12,
    "wave": 0.15,
    "mixture": 0.12,
    "homography": 0.04,
}
ROTATED_DEGREES = 15.0
_LATTICE = 21


def coefficients(guides: Guides) -> Float64:
    """(16,): top row, bottom row, left column, right column, c0 to c3 each."""
    return np.concatenate([guides.rows.coefficients.ravel(), guides.columns.coefficients.ravel()])


def distorted_sample(photograph: Bytes, rng: np.random.Generator) -> Sample:
    """A window of a photograph, uint8 (height, width, 3), under a random distortion, and the guides fitted to it."""
    names, shares = list(SHARES), np.array(list(SHARES.values()))
    kind = KINDS.index(names[rng.choice(len(names), p=shares / shares.sum())])
    distortion = draw_distortions(1, rng, np.array([kind]))
    picture = distorted(_window(photograph, rng), distortion)
    lattice = target_lattice(_LATTICE, _LATTICE).reshape(-1, 2)
    x, y, visible = distortion.bend(
        lattice[:, 0].astype(np.float32), lattice[:, 1].astype(np.float32), np.zeros(len(lattice), np.int64)
    )
    source = np.stack([x, y], 1).astype(np.float64)
    shown = visible & (np.abs(source) <= 1.02).all(1)
    guides = fit_guides(source[shown], lattice[shown], ANCHORS, DEGREE, polish=0)
    return _reduced(_relit(picture, rng)), coefficients(guides)


def annotated_sample(annotation: Annotation, rng: np.random.Generator) -> Sample:
    """An annotated photograph, turned by up to ROTATED_DEGREES with its annotation."""
    picture = cv2.imread(str(annotation.picture), cv2.IMREAD_GRAYSCALE)
    if picture is None:
        raise FileNotFoundError(f"{annotation.picture} is annotated but not there.")
    degrees = float(rng.uniform(-ROTATED_DEGREES, ROTATED_DEGREES))
    turned = rotated_guides(annotation.guides, annotation.width, annotation.height, degrees)
    height, width = picture.shape
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), -degrees, 1.0)
    picture = cv2.warpAffine(picture, matrix, (width, height), borderMode=cv2.BORDER_REFLECT_101)
    return _reduced(_relit(np.asarray(picture, np.uint8), rng)), coefficients(turned)


def rotated_guides(guides: Guides, width: int, height: int, degrees: float) -> Guides:
    """The guides of the picture, width x height px, turned clockwise about its centre, over ANCHORS.

    What was straight before is to be straight and upright after: the target stays, the source turns.
    """
    lattice = target_lattice(_LATTICE, _LATTICE, 0.98).reshape(-1, 2)
    half = np.array([width, height], np.float64)
    source = guides(lattice) * half
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return fit_guides(source @ turn.T / half, lattice, ANCHORS, DEGREE)


def photographs(folder: Path, split: str) -> list[Path]:
    """Paths of a split of `index.csv`, in its order."""
    with open(folder / "index.csv", newline="") as file:
        return [folder / row["path"] for row in csv.DictReader(file) if row["split"] == split]


def draw_samples(
    paths: list[Path], annotations: list[Annotation], size: int, rng: np.random.Generator
) -> Iterator[Sample]:
    """`size` samples; an annotation is as likely as a photograph."""
    for _ in range(size):
        choice = int(rng.integers(len(paths) + len(annotations)))
        if choice < len(paths):
            yield distorted_sample(np.asarray(cv2.imread(str(paths[choice])), np.uint8), rng)
        else:
            yield annotated_sample(annotations[choice - len(paths)], rng)


def _window(photograph: Bytes, rng: np.random.Generator) -> Bytes:
    """A random part, mirrored half of the time, squeezed to the FULL_PX square whose centre the distortion shows."""
    height, width = photograph.shape[:2]
    side = min(height, width) * rng.uniform(0.8, 1.0)
    wide, high = (int(min(limit, side * rng.uniform(1.0, 1.25))) for limit in (width, height))
    left, top = int(rng.integers(width - wide + 1)), int(rng.integers(height - high + 1))
    window = photograph[top : top + high, left : left + wide]
    if rng.random() < 0.5:
        window = window[:, ::-1]
    return np.asarray(cv2.resize(window, (FULL_PX, FULL_PX), interpolation=cv2.INTER_AREA), np.uint8)


def _relit(picture: Bytes, rng: np.random.Generator) -> Bytes:
    contrast, brightness = rng.uniform(0.75, 1.2), rng.uniform(-20, 20)
    noisy = picture * contrast + brightness + rng.normal(0, rng.uniform(0, 4), picture.shape)
    return np.asarray(noisy.clip(0, 255), np.uint8)


def _reduced(picture: Bytes) -> Bytes:
    return np.asarray(cv2.resize(picture, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_AREA), np.uint8)
