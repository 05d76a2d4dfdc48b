"""Annotations: curves that a person laid over features that ought to be straight, and the guides they make.

Points are in centred source coordinates, of the picture as it is seen (EXIF orientation applied).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from unbend_service.domain.errors import InvalidGuides
from unbend_service.domain.guides import TRUSTED_EXTENT, GuideFamily, Guides, power_basis

Float64 = npt.NDArray[np.float64]

VERSION = 1
DEGREE = 3
#: Curves of each direction: the paper's K = 2.
CURVES = 2
#: Points that determine a cubic.
LEAST_POINTS = DEGREE + 1
_MOST_POINTS = 256
#: Points may be put a little beyond the border, where a feature leaves the picture.
_FARTHEST = TRUSTED_EXTENT
_LONGEST_SIDE_PX = 1 << 16
_OUTERMOST_ANCHOR = 0.98


@dataclass(frozen=True, eq=False)
class Curve:
    """Points along one feature.

    Attributes:
        points: (n, 2) float64 (x, y), in the order in which they were put.
        upright: whether it is a column, x as a function of y.

    Raises:
        InvalidGuides: wrong shape, not finite, too many, or far outside the picture.
    """

    points: Float64
    upright: bool

    def __post_init__(self) -> None:
        points = np.array(self.points, dtype=np.float64).reshape(-1, 2)
        if len(points) > _MOST_POINTS:
            raise InvalidGuides(f"{len(points)} points along one curve.", allowed=f"at most {_MOST_POINTS}")
        if not np.isfinite(points).all() or (len(points) and np.abs(points).max() > _FARTHEST):
            raise InvalidGuides("A point lies far outside the picture.", allowed=f"-{_FARTHEST:g} to {_FARTHEST:g}")
        points.flags.writeable = False
        object.__setattr__(self, "points", points)

    @property
    def along(self) -> Float64:
        """(n,) the coordinate that the polynomial takes."""
        return self.points[:, 1 if self.upright else 0]

    @property
    def is_complete(self) -> bool:
        """Whether the points determine a cubic."""
        return len(np.unique(self.along)) >= LEAST_POINTS

    @property
    def coefficients(self) -> Float64:
        """(DEGREE + 1,) least squares through the points; of a lower degree, the rest zero, while they are too few."""
        fitted = np.zeros(DEGREE + 1)
        degree = min(DEGREE, len(np.unique(self.along)) - 1)
        if degree < 0:
            return fitted
        across = self.points[:, 0 if self.upright else 1]
        fitted[: degree + 1] = np.linalg.lstsq(power_basis(self.along, degree), across, rcond=None)[0]
        return fitted

    @property
    def anchor(self) -> float:
        """Mean of the curve between its outermost points: about where the feature lies once it is straight."""
        span = np.linspace(self.along.min(), self.along.max(), 65)
        mean = float((power_basis(span, DEGREE) @ self.coefficients).mean())
        return float(np.clip(mean, -_OUTERMOST_ANCHOR, _OUTERMOST_ANCHOR))


@dataclass(frozen=True, eq=False)
class Annotation:
    """What a person says of one picture: CURVES rows and CURVES columns.

    Attributes:
        image: file name of the picture.
        width, height: pixels of the picture as it is seen.
    """

    image: str
    width: int
    height: int
    rows: tuple[Curve, ...]
    columns: tuple[Curve, ...]

    @property
    def is_complete(self) -> bool:
        """Whether all curves are determined."""
        return all(curve.is_complete for curve in (*self.rows, *self.columns))

    def guides(self) -> Guides:
        """The guides, K = CURVES of degree DEGREE; raises InvalidGuides if it is not complete or curves coincide."""
        if not self.is_complete:
            raise InvalidGuides(
                f"The annotation of {self.image} is not complete.", allowed=f"{LEAST_POINTS} points each"
            )
        return Guides(_family(self.rows), _family(self.columns))

    def to_dict(self) -> dict[str, Any]:
        """The JSON beside the picture: {version, image, width, height, rows, columns: [{points, coefficients}]}."""
        return {
            "version": VERSION,
            "image": self.image,
            "width": self.width,
            "height": self.height,
            "rows": [_curve_to_dict(curve) for curve in self.rows],
            "columns": [_curve_to_dict(curve) for curve in self.columns],
        }

    @classmethod
    def from_dict(cls, value: Any) -> Annotation:
        """Inverse of :meth:`to_dict`; coefficients are computed anew. Raises InvalidGuides for anything else."""
        if not isinstance(value, dict) or value.get("version") != VERSION:
            raise InvalidGuides("An annotation must be an object of a known version.", allowed=f"version {VERSION}")
        image = value.get("image")
        if not isinstance(image, str):
            raise InvalidGuides("An annotation names its image.")
        width, height = _side_px(value.get("width")), _side_px(value.get("height"))
        rows, columns = (_curves_from_list(value.get(name), name == "columns") for name in ("rows", "columns"))
        return cls(image, width, height, rows, columns)


def _family(curves: tuple[Curve, ...]) -> GuideFamily:
    ordered = sorted(curves, key=lambda curve: curve.anchor)
    return GuideFamily(
        np.array([curve.anchor for curve in ordered]), np.stack([curve.coefficients for curve in ordered])
    )


def _side_px(value: Any) -> int:
    if type(value) is not int or not 1 <= value <= _LONGEST_SIDE_PX:
        raise InvalidGuides("An annotation has the width and height of its image in pixels.")
    return value


def _curve_to_dict(curve: Curve) -> dict[str, Any]:
    return {"points": curve.points.tolist(), "coefficients": curve.coefficients.tolist()}


def _curves_from_list(value: Any, upright: bool) -> tuple[Curve, ...]:
    if not isinstance(value, list) or len(value) != CURVES:
        raise InvalidGuides(f"An annotation has {CURVES} rows and {CURVES} columns.")
    try:
        lists = [[[float(x), float(y)] for x, y in curve["points"]] for curve in value]
    except (TypeError, KeyError, ValueError, OverflowError) as error:
        raise InvalidGuides("A curve of an annotation is an object with points, a list of [x, y].") from error
    return tuple(Curve(np.array(points).reshape(-1, 2), upright) for points in lists)
