"""Pictures whose distortion is known, and the photographs that they are made of."""

from __future__ import annotations

import csv
import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from unbend_service.domain.errors import InvalidOption
from unbend_service.domain.maps import BackwardMap, pixel_centres, target_lattice

Bytes = npt.NDArray[np.uint8]
Float64 = npt.NDArray[np.float64]

LATTICE_POINTS = 25
INDEX = "index.csv"
_SUFFIXES = (".jpg", ".jpeg", ".png")


@dataclass(frozen=True, eq=False)
class Case:
    """One distorted picture.

    Attributes:
        group: what its error is averaged with: a family, a camera.
        picture: grey uint8 (height, width), what a model is shown.
        truth: target -> source, centred; NaN or far outside where a target has no source.
        original: grey uint8 of the same size, what a perfect correction would show; None where there is none.
        source: of the photograph.
    """

    group: str
    picture: Bytes
    truth: BackwardMap
    original: Bytes | None = None
    source: str = ""

    @property
    def half_px(self) -> Float64:
        """(2,) pixels, of a picture whose long side is 256, to one centred unit across and down."""
        height, width = self.picture.shape
        scale = 128.0 / max(width, height)
        return np.array([width * scale, height * scale])

    def correspondences(self) -> tuple[Float64, Float64]:
        """Evenly spread target points whose source lies in the picture, and that source: both (n, 2), centred."""
        return self._correspondences

    @cached_property
    def shown(self) -> npt.NDArray[np.bool_]:
        """(height, width): pixels of the target whose source lies in the picture."""
        height, width = self.picture.shape
        source = self.truth(np.stack(np.meshgrid(pixel_centres(width), pixel_centres(height)), -1))
        with np.errstate(invalid="ignore"):
            return np.asarray((np.abs(source) <= 1 - 1 / np.array([width, height])).all(-1))

    @cached_property
    def _correspondences(self) -> tuple[Float64, Float64]:
        target = target_lattice(LATTICE_POINTS, LATTICE_POINTS, 1 - 1 / LATTICE_POINTS).reshape(-1, 2)
        source = self.truth(target)
        with np.errstate(invalid="ignore"):
            shown = (np.abs(source) <= 1).all(axis=1)
        return target[shown], source[shown]


@dataclass(frozen=True, eq=False)
class Photograph:
    """A straight photograph: BGR uint8 (height, width, 3), and where it comes from."""

    pixels: Bytes
    source: str
    path: Path


def read_photographs(folder: Path, limit: int, sources: tuple[str, ...] | None = None) -> list[Photograph]:
    """The photographs that models are measured on.

    With an ``index.csv`` (columns path, split, source): those of its validation split, in the order of the hashes of
    their paths, which mixes the sources. Without: all jpegs and pngs below the folder, in the order of their paths.

    Args:
        sources: only photographs of these.

    Raises:
        InvalidOption: there are none.
    """
    if (folder / INDEX).exists():
        with open(folder / INDEX, newline="") as file:
            rows = [row for row in csv.DictReader(file) if row["split"] == "val"]
        rows.sort(key=lambda row: hashlib.sha256(row["path"].encode()).hexdigest())
        found = [(folder / row["path"], row["source"]) for row in rows]
    else:
        paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in _SUFFIXES)
        found = [(path, path.parent.name) for path in paths]
    chosen = [(path, source) for path, source in found if sources is None or source in sources][:limit]
    if not chosen:
        raise InvalidOption(f"There are no photographs in {str(folder)!r}.", allowed="a folder of jpegs or pngs")
    return [Photograph(_read(path), source, path) for path, source in chosen]


def grey_of(pixels: Bytes) -> Bytes:
    """BGR or grey -> grey."""
    return pixels if pixels.ndim == 2 else np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), np.uint8)


def reduced(pixels: Bytes, long_side_px: int) -> Bytes:
    """Never enlarged."""
    scale = min(1.0, long_side_px / max(pixels.shape[:2]))
    return np.asarray(cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)


def _read(path: Path) -> Bytes:
    pixels = cv2.imread(str(path))
    if pixels is None:
        raise InvalidOption(f"{str(path)!r} is no picture that can be read.")
    return np.asarray(pixels, np.uint8)
