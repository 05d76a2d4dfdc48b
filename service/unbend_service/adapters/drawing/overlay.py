"""Estimates drawn over their picture with OpenCV.

Every line is a bright core on a dark halo, so that it is legible on light and on dark pictures, and its width follows
the size of the picture. Points are placed with sub-pixel precision.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from unbend_service.adapters.drawing.legend import draw_legend
from unbend_service.application.ports import Bytes
from unbend_service.domain.errors import InvalidFrame
from unbend_service.domain.frames import Frame, PixelFormat
from unbend_service.domain.grid import Grid
from unbend_service.domain.guides import Guides
from unbend_service.domain.maps import Float64, target_lattice

# Okabe and Ito's colours: told apart by colour-blind readers as well.
_ROWS = (255, 176, 0)
_COLUMNS = (86, 200, 255)
_HALO = (0, 0, 0)
_HALO_OPACITY = 0.6
_SUBPIXEL_BITS = 4
_GUIDE_POINTS = 256
_LONG_SIDE_LINES = 17
_LONG_SIDE_ARROWS = 18
_EXAGGERATIONS = (1, 2, 3, 4, 5, 7, 10, 15, 20, 30, 50, 100)
#: Below this, in pixels, nothing visible moves and no exaggeration is wanted.
_STILL_PX = 0.05


class OverlayIllustrator:
    """Port Illustrator. Stateless."""

    def guides(self, frame: Frame, guides: Guides) -> Frame:
        """Row guides in amber, column guides in blue, each from edge to edge; rgb24 of the size of ``frame``."""
        canvas = _canvas(frame)
        along = np.linspace(-1, 1, _GUIDE_POINTS)
        powers = along[:, None] ** np.arange(guides.rows.degree + 1)
        rows = [np.stack([along, powers @ c], -1) for c in guides.rows.coefficients]
        powers = along[:, None] ** np.arange(guides.columns.degree + 1)
        columns = [np.stack([powers @ c, along], -1) for c in guides.columns.coefficients]
        width = _line_width(canvas, 320)
        _draw_curves(canvas, [(rows, _ROWS), (columns, _COLUMNS)], width)
        return _frame(canvas)

    def grid(self, frame: Frame, grid: Grid) -> Frame:
        """The lattice that becomes regular, its rim in amber; rgb24 of the size of ``frame``."""
        canvas = _canvas(frame)
        lattice = grid.source.astype(np.float64)
        rows, columns = _counts(canvas, _LONG_SIDE_LINES)
        inner = [lattice[r] for r in _spread(grid.rows, rows)[1:-1]]
        inner += [lattice[:, c] for c in _spread(grid.columns, columns)[1:-1]]
        rim = [lattice[0], lattice[-1], lattice[:, 0], lattice[:, -1]]
        width = _line_width(canvas, 500)
        _draw_curves(canvas, [(inner, _COLUMNS), (rim, _ROWS)], width)
        return _frame(canvas)

    def displacement(self, frame: Frame, grid: Grid) -> Frame:
        """Arrows from where the picture is to where it goes, coloured by length, with a legend in pixels.

        Short displacements are drawn longer than they are, by a factor that the legend names.
        """
        canvas = _canvas(frame)
        height, width = canvas.shape[:2]
        rows, columns = _counts(canvas, _LONG_SIDE_ARROWS)
        r, c = np.meshgrid(_spread(grid.rows, rows), _spread(grid.columns, columns), indexing="ij")
        source = grid.source.astype(np.float64)
        target = target_lattice(grid.rows, grid.columns)
        moves_px = (target - source) * np.array([width, height]) / 2
        lengths_px = np.hypot(moves_px[..., 0], moves_px[..., 1])
        longest_px, mean_px = float(lengths_px.max()), float(lengths_px.mean())
        spacing_px = max(width, height) / _LONG_SIDE_ARROWS
        # a single corner that flies away must not make all other arrows dots
        factor = _exaggeration(float(np.percentile(lengths_px[r, c], 90)), spacing_px)
        starts = _pixels(source[r, c], canvas).reshape(-1, 2)
        moves = moves_px[r, c].reshape(-1, 2)
        _draw_arrows(canvas, starts, moves, factor, longest_px)
        draw_legend(canvas, longest_px, mean_px, factor, spacing_px)
        return _frame(canvas)


def _canvas(frame: Frame) -> Bytes:
    """(height, width, 3) uint8 rgb, writable; alpha is shown over white."""
    pixels = frame.plane_arrays()[0]
    if frame.pixel_format is PixelFormat.GRAY8:
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_GRAY2RGB), dtype=np.uint8)
    if frame.pixel_format is PixelFormat.RGB24:
        return np.array(pixels)
    if frame.pixel_format is PixelFormat.BGR24:
        return np.array(pixels[..., ::-1])
    if frame.pixel_format in (PixelFormat.RGBA, PixelFormat.BGRA):
        alpha = pixels[..., 3:].astype(np.uint16)
        colours = pixels[..., :3] if frame.pixel_format is PixelFormat.RGBA else pixels[..., 2::-1]
        return np.asarray((colours * alpha + 255 * (255 - alpha) + 127) // 255, dtype=np.uint8)
    raise InvalidFrame(f"Nothing is drawn over {frame.pixel_format} frames.", allowed="gray8, rgb24, bgr24, rgba, bgra")


def _frame(canvas: Bytes) -> Frame:
    return Frame(PixelFormat.RGB24, canvas.shape[1], canvas.shape[0], canvas.reshape(-1))


def _line_width(canvas: Bytes, per_width: int) -> int:
    longest_px: int = max(canvas.shape[:2])
    return max(1, round(longest_px / per_width))


def _counts(canvas: Bytes, long_side: int) -> tuple[int, int]:
    """Rows and columns of a lattice of about square cells."""
    height, width = canvas.shape[:2]
    scale = (long_side - 1) / max(height, width)
    return max(2, round(height * scale) + 1), max(2, round(width * scale) + 1)


def _spread(available: int, wanted: int) -> npt.NDArray[np.intp]:
    return np.unique(np.linspace(0, available - 1, min(available, wanted)).round().astype(np.intp))


def _pixels(points: Float64, canvas: Bytes) -> Float64:
    """Centred points -> OpenCV's pixels, whose centres lie at whole numbers."""
    height, width = canvas.shape[:2]
    return np.asarray((points + 1) / 2 * np.array([width, height]) - 0.5)


def _fixed(pixels: Float64) -> npt.NDArray[np.int32]:
    return (pixels * (1 << _SUBPIXEL_BITS)).round().astype(np.int32)


def _draw_curves(canvas: Bytes, families: list[tuple[list[Float64], tuple[int, int, int]]], width: int) -> None:
    drawn = [([_fixed(_pixels(curve, canvas)) for curve in curves], colour) for curves, colour in families]
    _draw_halo(canvas, [curve for curves, _ in drawn for curve in curves], width)
    for curves, colour in drawn:
        cv2.polylines(canvas, curves, False, colour, width, cv2.LINE_AA, _SUBPIXEL_BITS)


def _draw_halo(canvas: Bytes, curves: list[npt.NDArray[np.int32]], width: int) -> None:
    """Darkens the surroundings of all curves, before any core is drawn, so that no halo cuts through another core."""
    dark = canvas.copy()
    cv2.polylines(dark, curves, False, _HALO, width + 2 * max(1, width // 2), cv2.LINE_AA, _SUBPIXEL_BITS)
    cv2.addWeighted(dark, _HALO_OPACITY, canvas, 1 - _HALO_OPACITY, 0, dst=canvas)


def _exaggeration(long_px: float, spacing_px: float) -> int:
    """The largest factor with which an arrow of ``long_px`` is drawn about one cell long."""
    if long_px < _STILL_PX:
        return 1
    fitting = [factor for factor in _EXAGGERATIONS if factor * long_px <= 1.1 * spacing_px]
    return max(fitting, default=1)


def _draw_arrows(canvas: Bytes, starts: Float64, moves: Float64, factor: int, longest_px: float) -> None:
    width = _line_width(canvas, 700)
    head_px = 5.0 * width + 2
    lengths = np.hypot(moves[:, 0], moves[:, 1])
    shares = lengths / max(longest_px, _STILL_PX)
    steps = (60 + 195 * shares).astype(np.uint8).reshape(-1, 1)  # the darkest part of the map is left out
    colours = cv2.applyColorMap(steps, cv2.COLORMAP_TURBO)[:, 0, ::-1].tolist()
    pairs = zip(starts, moves, strict=True)
    strokes = [[_fixed(part) for part in _arrow(start, move * factor, head_px)] for start, move in pairs]
    _draw_halo(canvas, [part for stroke in strokes for part in stroke], width)
    for stroke, colour in zip(strokes, colours, strict=True):
        cv2.polylines(canvas, stroke, False, colour, width, cv2.LINE_AA, _SUBPIXEL_BITS)


def _arrow(start: Float64, move: Float64, head_px: float) -> list[Float64]:
    """Shaft and head as polylines; a move too short for a head is a dot."""
    length = float(np.hypot(*move))
    end = start + move
    if length < head_px / 2:
        return [np.stack([start, end])]
    forward = move / length * min(head_px, length / 2)
    aside = np.array([-forward[1], forward[0]]) * 0.55
    return [np.stack([start, end]), np.stack([end - forward + aside, end, end - forward - aside])]
