"""Figures for a paper: what an estimate says of a picture, side by side and with legends, as pixels or as SVG."""

from __future__ import annotations

import cv2
import numpy as np

from unbend_service.adapters.drawing.legends import colours_legend
from unbend_service.adapters.drawing.overlays import canvas_of, displacement_scene, grid_scene, guides_scene
from unbend_service.adapters.drawing.rasters import rasterised
from unbend_service.adapters.drawing.scene import Item, Label, Placed, Raster, Scene
from unbend_service.adapters.drawing.vectors import vectorised
from unbend_service.application.exhibit import Exhibit, Subject
from unbend_service.domain.dense_maps import pixel_maps
from unbend_service.domain.errors import InvalidOption
from unbend_service.domain.frames import Frame, PixelFormat
from unbend_service.domain.grid import Grid

_INK = (20, 20, 20)
_LENGTHS = cv2.COLORMAP_VIRIDIS


class FigureIllustrator:
    """Port Illustrator. Stateless."""

    def raster(self, subject: Subject, exhibit: Exhibit) -> Frame:
        """The figure as rgb24."""
        scene = figure(subject, exhibit)
        return Frame(PixelFormat.RGB24, scene.width, scene.height, rasterised(scene).reshape(-1))

    def vector(self, subject: Subject, exhibit: Exhibit) -> bytes:
        """The figure as SVG."""
        return vectorised(figure(subject, exhibit)).encode()


def figure(subject: Subject, exhibit: Exhibit) -> Scene:
    """The scene of a figure.

    Raises:
        InvalidOption: guides of a grid that has none.
        InvalidFrame: a planar frame.
    """
    match subject:
        case Subject.GUIDES:
            if exhibit.guides is None:
                raise InvalidOption("The grid has no guides.", allowed="grid or displacement")
            return guides_scene(exhibit.frame, exhibit.guides)
        case Subject.GRID:
            return grid_scene(exhibit.frame, exhibit.grid)
        case Subject.DISPLACEMENT:
            return displacement_scene(exhibit.frame, exhibit.grid)
        case Subject.GRIDS:
            return _grids(exhibit)
        case Subject.MAGNITUDE:
            return _magnitude(exhibit.frame, exhibit.grid)
        case Subject.SHEET:
            return _sheet(exhibit)


def _grids(exhibit: Exhibit) -> Scene:
    """The grid over the source as it was drawn, and the same grid, straight, over the corrected picture."""
    drawn = exhibit.drawn or exhibit.grid
    left = grid_scene(exhibit.frame, drawn)
    right = grid_scene(exhibit.straight or exhibit.frame, Grid.identity(drawn.rows, drawn.columns))
    return _stacked([[(left, "estimated grid"), (right, "straightened")]])


def _sheet(exhibit: Exhibit) -> Scene:
    """Before and after above, guides (or the displacement) and grid below."""
    frame = exhibit.frame
    if exhibit.guides is not None:
        third = guides_scene(frame, exhibit.guides), "guides"
    else:
        third = displacement_scene(frame, exhibit.grid), "displacement"
    before, after = (
        Scene(frame.width, frame.height, [Raster(canvas_of(one))]) for one in (frame, exhibit.straight or frame)
    )
    return _stacked([[(before, "before"), (after, "after")], [third, (grid_scene(frame, exhibit.grid), "grid")]])


def _magnitude(frame: Frame, grid: Grid) -> Scene:
    """How far each pixel of the corrected picture comes, as a colour map over it in grey, with a bar in pixels."""
    pixels = canvas_of(frame)
    height, width = pixels.shape[:2]
    map_x, map_y = pixel_maps(grid, width, height)
    y, x = np.mgrid[0:height, 0:width]
    length_px = np.hypot(map_x - x, map_y - y)
    longest_px = max(float(np.percentile(length_px, 99.5)), 0.1)
    levels = np.clip(length_px / longest_px * 255, 0, 255).astype(np.uint8)
    colours = cv2.applyColorMap(levels, _LENGTHS)[..., ::-1]
    grey = cv2.cvtColor(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    blended = cv2.addWeighted(np.ascontiguousarray(colours), 0.7, np.asarray(grey, np.uint8), 0.3, 0)
    legend = colours_legend(height, longest_px, _LENGTHS)
    return Scene(width + legend.width, height, [Raster(np.asarray(blended, np.uint8)), Placed(legend, width, 0)])


def _stacked(rows: list[list[tuple[Scene, str]]]) -> Scene:
    """Rows of panels of one size on white, each with its name under it."""
    width, height = rows[0][0][0].width, rows[0][0][0].height
    gap, size = max(6, width // 60), max(11.0, width / 36)
    caption = round(1.9 * size)
    items: list[Item] = []
    for r, panels in enumerate(rows):
        for c, (panel, name) in enumerate(panels):
            left, top = c * (width + gap), r * (height + caption)
            items.append(Placed(panel, left, top))
            items.append(Label(name, left + width / 2, top + height + 1.25 * size, size, _INK, "middle"))
    columns = max(len(panels) for panels in rows)
    return Scene(columns * (width + gap) - gap, len(rows) * (height + caption), items)
