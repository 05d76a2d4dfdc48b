"""Figures for a paper: what an estimate says of a picture, side by side and with legends.

All are rgb24 frames; :func:`svg_of` writes the same guides and grids as vectors over the picture.
"""

from __future__ import annotations

import base64

import cv2
import numpy as np

from unbend_service.adapters.drawing.overlay import OverlayIllustrator
from unbend_service.application.ports import Bytes
from unbend_service.domain.dense_maps import pixel_maps
from unbend_service.domain.frames import Frame, PixelFormat
from unbend_service.domain.grid import Grid
from unbend_service.domain.guides import Guides
from unbend_service.domain.maps import Float64

_FONT = cv2.FONT_HERSHEY_SIMPLEX
_WHITE, _INK = (255, 255, 255), (20, 20, 20)
_BAR_STEPS = 5
_LINES = 17
_ROWS, _COLUMNS = "#ffb000", "#56c8ff"


def grids_figure(frame: Frame, straight: Frame, grid: Grid) -> Frame:
    """The estimated grid over the source, and the straight grid over the corrected picture."""
    illustrator = OverlayIllustrator()
    left = _pixels(illustrator.grid(frame, grid))
    right = _pixels(illustrator.grid(straight, Grid.identity(grid.rows, grid.columns)))
    return _framed(_row([(left, "estimated grid"), (right, "straightened")]))


def sheet_figure(frame: Frame, straight: Frame, guides: Guides | None, grid: Grid) -> Frame:
    """Before and after above, guides (or the displacement) and grid below."""
    illustrator = OverlayIllustrator()
    third = illustrator.guides(frame, guides) if guides is not None else illustrator.displacement(frame, grid)
    name = "guides" if guides is not None else "displacement"
    top = _row([(_pixels(frame), "before"), (_pixels(straight), "after")])
    below = _row([(_pixels(third), name), (_pixels(illustrator.grid(frame, grid)), "grid")])
    return _framed(np.concatenate([top, below]))


def magnitude_figure(frame: Frame, grid: Grid) -> Frame:
    """How far each pixel of the corrected picture comes, as a colour map over it in grey, with a bar in pixels."""
    pixels = _pixels(frame)
    height, width = pixels.shape[:2]
    map_x, map_y = pixel_maps(grid, width, height)
    y, x = np.mgrid[0:height, 0:width]
    length_px = np.hypot(map_x - x, map_y - y)
    longest_px = max(float(np.percentile(length_px, 99.5)), 0.1)
    levels = np.clip(length_px / longest_px * 255, 0, 255).astype(np.uint8)
    colours = cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS)[..., ::-1]
    grey = cv2.cvtColor(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    blended = cv2.addWeighted(np.ascontiguousarray(colours), 0.7, np.asarray(grey, np.uint8), 0.3, 0)
    return _framed(np.concatenate([np.asarray(blended, np.uint8), _bar(height, longest_px)], axis=1))


def svg_of(frame: Frame, guides: Guides | None, grid: Grid | None) -> str:
    """An SVG of the picture (embedded as PNG) with guides or a grid as paths; for papers, scalable."""
    pixels = _pixels(frame)
    height, width = pixels.shape[:2]
    encoded = base64.b64encode(cv2.imencode(".png", pixels[..., ::-1])[1].tobytes()).decode()
    families = _guide_curves(guides) if guides is not None else _grid_curves(grid or Grid.identity())
    stroke = max(1.0, max(width, height) / 400)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}">',
        f'<image width="{width}" height="{height}" href="data:image/png;base64,{encoded}"/>',
    ]
    for colour, curves in families:
        points = [
            " ".join(f"{(x + 1) / 2 * width:.2f},{(y + 1) / 2 * height:.2f}" for x, y in curve) for curve in curves
        ]
        lines = "".join(f'<polyline points="{line}"/>' for line in points)
        parts.append(f'<g fill="none" stroke="#000" stroke-opacity=".5" stroke-width="{2 * stroke:.2f}">{lines}</g>')
        parts.append(f'<g fill="none" stroke="{colour}" stroke-width="{stroke:.2f}">{lines}</g>')
    return "\n".join([*parts, "</svg>", ""])


def _guide_curves(guides: Guides) -> list[tuple[str, list[Float64]]]:
    along = np.linspace(-1, 1, 65)
    rows = [np.stack([along, np.polynomial.polynomial.polyval(along, c)], -1) for c in guides.rows.coefficients]
    columns = [np.stack([np.polynomial.polynomial.polyval(along, c), along], -1) for c in guides.columns.coefficients]
    return [(_ROWS, rows), (_COLUMNS, columns)]


def _grid_curves(grid: Grid) -> list[tuple[str, list[Float64]]]:
    lattice = grid.source.astype(np.float64)
    rows = np.linspace(0, grid.rows - 1, min(_LINES, grid.rows)).round().astype(int)
    columns = np.linspace(0, grid.columns - 1, min(_LINES, grid.columns)).round().astype(int)
    return [(_ROWS, [lattice[r] for r in rows]), (_COLUMNS, [lattice[:, c] for c in columns])]


def _pixels(frame: Frame) -> Bytes:
    """(height, width, 3) uint8 of gray8, rgb24 or rgba."""
    first = frame.plane_arrays()[0]
    if frame.pixel_format is PixelFormat.GRAY8:
        return np.asarray(cv2.cvtColor(first, cv2.COLOR_GRAY2RGB), dtype=np.uint8)
    return np.ascontiguousarray(first[..., :3])


def _row(panels: list[tuple[Bytes, str]]) -> Bytes:
    """Panels of one size beside each other on white, each with its name under it."""
    height, width = panels[0][0].shape[:2]
    scale = max(0.4, width / 900)
    gap, caption = max(6, width // 60), round(44 * scale)
    cells = []
    for pixels, name in panels:
        cell = np.full((height + caption, width + gap, 3), 255, np.uint8)
        cell[:height, gap // 2 : gap // 2 + width] = pixels
        thick = max(1, round(1.5 * scale))
        (text_width, _), _ = cv2.getTextSize(name, _FONT, scale, thick)
        place = (gap // 2 + (width - text_width) // 2, height + round(30 * scale))
        cv2.putText(cell, name, place, _FONT, scale, _INK, thick, cv2.LINE_AA)
        cells.append(cell)
    return np.concatenate(cells, axis=1)


def _bar(height: int, longest_px: float) -> Bytes:
    """The colours of the lengths, with their numbers in pixels."""
    scale = max(0.4, height / 1000)
    thick = max(1, round(1.5 * scale))
    width, bar = round(200 * scale), round(36 * scale)
    panel = np.full((height, width, 3), 255, np.uint8)
    top, bottom = height // 12, height - height // 12
    levels = np.linspace(255, 0, bottom - top).astype(np.uint8)[:, None]
    left = round(22 * scale)
    panel[top:bottom, left : left + bar] = cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS)[:, :, ::-1]
    for step in range(_BAR_STEPS + 1):
        y = round(bottom - 1 - (bottom - 1 - top) * step / _BAR_STEPS)
        text = f"{longest_px * step / _BAR_STEPS:.{2 if longest_px < 5 else 1}f}"
        cv2.line(panel, (left + bar, y), (left + bar + left // 3, y), _INK, thick)
        place = (left + bar + left // 2 + thick, y + round(10 * scale))
        cv2.putText(panel, text, place, _FONT, scale, _INK, thick, cv2.LINE_AA)
    cv2.putText(panel, "px", (left, top - round(14 * scale)), _FONT, scale, _INK, thick, cv2.LINE_AA)
    return panel


def _framed(pixels: Bytes) -> Frame:
    return Frame(PixelFormat.RGB24, pixels.shape[1], pixels.shape[0], np.ascontiguousarray(pixels).reshape(-1))
