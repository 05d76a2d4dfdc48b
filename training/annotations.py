"""Annotations of people as training material: the JSON files that ``unbend annotate`` leaves beside photographs."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from unbend_service.domain import annotation
from unbend_service.domain.errors import InvalidGuides
from unbend_service.domain.guides import Guides

SUFFIX = ".unbend.json"


@dataclass(frozen=True, eq=False)
class Annotation:
    """One annotated photograph.

    Attributes:
        picture: the photograph; beside the annotation, whether or not it is there.
        width, height: pixels, EXIF orientation applied.
        guides: K = 2, degree 3, centred source coordinates; least squares through the points.
        residual: root mean square distance of the points from their curves, in half picture widths and heights.
    """

    picture: Path
    width: int
    height: int
    guides: Guides
    residual: float

    def coefficients(self) -> npt.NDArray[np.float64]:
        """(16,) float64, the paper's numbers: top row, bottom row, left column, right column, c0 to c3 each."""
        return np.concatenate([self.guides.rows.coefficients.ravel(), self.guides.columns.coefficients.ravel()])


def read_annotation(path: Path) -> Annotation:
    """Reads one ``NAME.unbend.json``.

    Raises:
        InvalidGuides: it is not an annotation, or not complete.
        OSError: it cannot be read.
    """
    try:
        value = json.loads(path.read_bytes())
    except ValueError as error:
        raise InvalidGuides(f"{path.name} is not JSON: {error}.") from error
    drawn = annotation.Annotation.from_dict(value)
    squares = np.concatenate([_distances(curve) for curve in (*drawn.rows, *drawn.columns)]) ** 2
    return Annotation(
        picture=path.with_name(path.name.removesuffix(SUFFIX)),
        width=drawn.width,
        height=drawn.height,
        guides=drawn.guides(),
        residual=float(np.sqrt(squares.mean())),
    )


def read_annotations(folder: Path) -> Iterator[Annotation]:
    """All complete annotations below ``folder``, in the order of their paths; unfinished ones are passed over."""
    for path in sorted(folder.rglob(f"*{SUFFIX}")):
        try:
            yield read_annotation(path)
        except InvalidGuides:
            continue


def _distances(curve: annotation.Curve) -> npt.NDArray[np.float64]:
    across = curve.points[:, 0 if curve.upright else 1]
    return np.asarray(np.polynomial.polynomial.polyval(curve.along, curve.coefficients) - across)
