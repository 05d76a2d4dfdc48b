"""The forms in which grids travel to and from other programs."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from unbend_service.domain.fit import KEEP, Fit
from unbend_service.domain.grid import Float32


class ExportFormat(StrEnum):
    """What a grid is written as."""

    JSON = "json"
    NPZ = "npz"
    NPZ_FIXED = "npz-fixed"
    STMAP_EXR = "stmap-exr"
    STMAP_TIFF = "stmap-tiff"
    FFMPEG = "ffmpeg"


class ImportFormat(StrEnum):
    """What a grid is read from."""

    JSON = "json"
    NPZ = "npz"
    STMAP_EXR = "stmap-exr"
    STMAP_TIFF = "stmap-tiff"
    OPENCV = "opencv"
    LENSFUN = "lensfun"


class Direction(StrEnum):
    """Which picture a map draws: the straight one from the bent one, or the bent one from the straight one."""

    UNDISTORT = "undistort"
    REDISTORT = "redistort"


@dataclass(frozen=True, slots=True)
class ExportOptions:
    """What is exported of a grid.

    Attributes:
        width, height: pixels of both pictures; needed by all formats but json.
        direction, fit, strength: the map is that of the grid with strength and fit, or its inverse.
    """

    width: int | None = None
    height: int | None = None
    direction: Direction = Direction.UNDISTORT
    fit: Fit = KEEP
    strength: float = 1.0


@dataclass(frozen=True, slots=True)
class ImportOptions:
    """How a file is to be read.

    Attributes:
        direction: which picture the map in the file draws; a redistortion is inverted.
        points: rows and columns of the grid that is made, 2..1025; not of a json file, whose lattice is kept.
    """

    direction: Direction = Direction.UNDISTORT
    points: int = 129


@dataclass(frozen=True, slots=True)
class DenseMap:
    """A map of every pixel, to be written.

    Attributes:
        map_x, map_y: (height, width) float32 source pixels of each target pixel, centres at whole numbers; source and
            target have the same size.
    """

    map_x: Float32
    map_y: Float32

    @property
    def width(self) -> int:
        return int(self.map_x.shape[1])

    @property
    def height(self) -> int:
        return int(self.map_x.shape[0])


@dataclass(frozen=True, slots=True)
class ExportedFile:
    """A file for another program.

    Attributes:
        suffix: with its dot.
    """

    body: bytes
    media_type: str
    suffix: str
