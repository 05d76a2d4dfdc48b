"""Estimates over their picture: guides, grid and displacement as scenes of the size of the picture.

Every line is a bright core on a dark halo, and its width follows the size of the picture.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from unbend_service.adapters.drawing.legends import arrows_legend
from unbend_service.adapters.drawing.scene import Colour, Raster, Scene, Strokes
from unbend_service.application.ports import Bytes
from unbend_service.domain.errors import InvalidFrame
from unbend_service.domain.frames import Frame, PixelFormat
from unbend_service.domain.grid import Grid
from unbend_service.domain.guides import Guides
from unbend_service.domain.maps import Float64, target_lattice

# Okabe and Ito's colours: told apart by colour-blind readers as well.
ROWS: Colour = (255, 176, 0)
COLUMNS: Colour = (86, 200, 255)
_GUIDE_POINTS = 256
_LONG_SIDE_LINES = 17
_LONG_SIDE_ARROWS = 18
_EXAGGERATIONS = (1, 2, 3, 4, 5, 7, 10, 15, 20, 30, 50, 100)
#: Below this, in pixels, nothing visible moves and no exaggeration is wanted.
_STILL_PX = 0.05
#: Arrows are of so many colours at most, each a family of strokes.
_COLOUR_STEPS = 24


def guides_scene(frame: Frame, guides: Guides) -> Scene:
    """Row guides in amber, column guides in blue, each from edge to edge."""
    along = np.linspace(-1, 1, _GUIDE_POINTS)
    powers = along[:, None] ** np.arange(guides.rows.degree + 1)
    rows = [np.stack([along, powers @ c], -1) for c in guides.rows.coefficients]
    powers = along[:, None] ** np.arange(guides.columns.degree + 1)
    columns = [np.stack([powers @ c, along], -1) for c in guides.columns.coefficients]
    return _over(frame, [(rows, ROWS), (columns, COLUMNS)], 320)


def grid_scene(frame: Frame, grid: Grid) -> Scene:
    """The lattice that becomes regular, its rim in amber."""
    lattice = grid.source.astype(np.float64)
    rows, columns = _counts(frame, _LONG_SIDE_LINES)
    inner = [lattice[r] for r in _spread(grid.rows, rows)[1:-1]]
    inner += [lattice[:, c] for c in _spread(grid.columns, columns)[1:-1]]
    rim = [lattice[0], lattice[-1], lattice[:, 0], lattice[:, -1]]
    return _over(frame, [(inner, COLUMNS), (rim, ROWS)], 500)


def displacement_scene(frame: Frame, grid: Grid) -> Scene:
    """Arrows from where the picture is to where it goes, coloured by length, with a legend in pixels.

    Short displacements are drawn longer than they are, by a factor that the legend names.
    """
    rows, columns = _counts(frame, _LONG_SIDE_ARROWS)
    r, c = np.meshgrid(_spread(grid.rows, rows), _spread(grid.columns, columns), indexing="ij")
    source = grid.source.astype(np.float64)
    moves_px = (target_lattice(grid.rows, grid.columns) - source) * np.array([frame.width, frame.height]) / 2
    lengths_px = np.hypot(moves_px[..., 0], moves_px[..., 1])
    longest_px, mean_px = float(lengths_px.max()), float(lengths_px.mean())
    spacing_px = max(frame.width, frame.height) / _LONG_SIDE_ARROWS
    # a single corner that flies away must not make all other arrows dots
    factor = _exaggeration(float(np.percentile(lengths_px[r, c], 90)), spacing_px)
    starts = _pixels(source[r, c], frame).reshape(-1, 2)
    scene = Scene(frame.width, frame.height, [Raster(canvas_of(frame))])
    scene.items.append(_arrows(frame, starts, moves_px[r, c].reshape(-1, 2), factor, longest_px))
    scene.items.extend(arrows_legend(frame.width, frame.height, longest_px, mean_px, factor, spacing_px))
    return scene


def canvas_of(frame: Frame) -> Bytes:
    """(height, width, 3) uint8 rgb; alpha is shown over white.

    Raises:
        InvalidFrame: a planar frame.
    """
    pixels = frame.plane_arrays()[0]
    if frame.pixel_format is PixelFormat.GRAY8:
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_GRAY2RGB), dtype=np.uint8)
    if frame.pixel_format is PixelFormat.RGB24:
        return pixels
    if frame.pixel_format is PixelFormat.BGR24:
        return np.ascontiguousarray(pixels[..., ::-1])
    if frame.pixel_format in (PixelFormat.RGBA, PixelFormat.BGRA):
        alpha = pixels[..., 3:].astype(np.uint16)
        colours = pixels[..., :3] if frame.pixel_format is PixelFormat.RGBA else pixels[..., 2::-1]
        return np.asarray((colours * alpha + 255 * (255 - alpha) + 127) // 255, dtype=np.uint8)
    raise InvalidFrame(f"Nothing is drawn over {frame.pixel_format} frames.", allowed="gray8, rgb24, bgr24, rgba, bgra")


def _over(frame: Frame, families: list[tuple[list[Float64], Colour]], per_width: int) -> Scene:
    placed = [([_pixels(curve, frame) for curve in curves], colour) for curves, colour in families]
    return Scene(frame.width, frame.height, [Raster(canvas_of(frame)), Strokes(placed, _line_width(frame, per_width))])


def _line_width(frame: Frame, per_width: int) -> int:
    return max(1, round(max(frame.width, frame.height) / per_width))


def _counts(frame: Frame, long_side: int) -> tuple[int, int]:
    """Rows and columns of a lattice of about square cells."""
    scale = (long_side - 1) / max(frame.height, frame.width)
    return max(2, round(frame.height * scale) + 1), max(2, round(frame.width * scale) + 1)


def _spread(available: int, wanted: int) -> npt.NDArray[np.intp]:
    return np.unique(np.linspace(0, available - 1, min(available, wanted)).round().astype(np.intp))


def _pixels(points: Float64, frame: Frame) -> Float64:
    """Centred points -> pixels of the scene."""
    return np.asarray((points + 1) / 2 * np.array([frame.width, frame.height]))


def _exaggeration(long_px: float, spacing_px: float) -> int:
    """The largest factor with which an arrow of ``long_px`` is drawn about one cell long."""
    if long_px < _STILL_PX:
        return 1
    fitting = [factor for factor in _EXAGGERATIONS if factor * long_px <= 1.1 * spacing_px]
    return max(fitting, default=1)


def _arrows(frame: Frame, starts: Float64, moves: Float64, factor: int, longest_px: float) -> Strokes:
    width = _line_width(frame, 700)
    shares = np.hypot(moves[:, 0], moves[:, 1]) / max(longest_px, _STILL_PX)
    steps = (shares * (_COLOUR_STEPS - 1)).round().astype(np.intp)
    # the darkest part of the map is left out
    levels = np.linspace(60, 255, _COLOUR_STEPS).astype(np.uint8).reshape(-1, 1)
    colours = cv2.applyColorMap(levels, cv2.COLORMAP_TURBO)[:, 0, ::-1].tolist()
    families = []
    for step in np.unique(steps):
        here = np.nonzero(steps == step)[0]
        parts = [part for i in here for part in _arrow(starts[i], moves[i] * factor, 5.0 * width + 2)]
        families.append((parts, tuple(colours[step])))
    return Strokes(families, width)


def _arrow(start: Float64, move: Float64, head_px: float) -> list[Float64]:
    """Shaft and head as polylines; a move too short for a head is a dot."""
    length = float(np.hypot(*move))
    end = start + move
    if length < head_px / 2:
        return [np.stack([start, end])]
    forward = move / length * min(head_px, length / 2)
    aside = np.array([-forward[1], forward[0]]) * 0.55
    return [np.stack([start, end]), np.stack([end - forward + aside, end, end - forward - aside])]
