"""Scenes: figures as lists of what is on them, before anybody decides between pixels and vectors.

Coordinates are pixels of the scene, x to the right and y down, with the origin at the corner of the first pixel: pixel
centres lie at half-integers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from unbend_service.application.ports import Bytes
from unbend_service.domain.maps import Float64

Colour = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class Raster:
    """A picture, (height, width, 3) uint8 rgb, with its upper left corner at (left, top)."""

    pixels: Bytes
    left: float = 0
    top: float = 0


@dataclass(frozen=True, slots=True)
class Strokes:
    """Curves on a common dark halo, so that they are legible on any ground.

    Attributes:
        families: curves, each (n, 2) float64, and the colour that they share.
        width_px: of the bright core.
        halo: whether there is one.
    """

    families: Sequence[tuple[Sequence[Float64], Colour]]
    width_px: float
    halo: bool = True


@dataclass(frozen=True, slots=True)
class Block:
    """A filled rectangle; ``opacity`` 0..1."""

    left: float
    top: float
    width: float
    height: float
    colour: Colour
    opacity: float = 1.0


@dataclass(frozen=True, slots=True)
class Label:
    """One line of text on the baseline ``y``."""

    text: str
    x: float
    y: float
    size_px: float
    colour: Colour
    anchor: Literal["start", "middle", "end"] = "start"


@dataclass(frozen=True, slots=True)
class Placed:
    """A scene within a scene, cut off at its edges."""

    scene: Scene
    left: float
    top: float


Item = Raster | Strokes | Block | Label | Placed


@dataclass(frozen=True, slots=True)
class Scene:
    """A white sheet of ``width`` x ``height`` pixels and what is on it, bottom first."""

    width: int
    height: int
    items: list[Item] = field(default_factory=list)
