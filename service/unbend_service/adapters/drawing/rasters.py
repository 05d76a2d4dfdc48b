"""Scenes as pixels, with OpenCV, and Pillow for text. Points are placed with sub-pixel precision."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from unbend_service.adapters.drawing.scene import Block, Label, Placed, Raster, Scene, Strokes
from unbend_service.application.ports import Bytes
from unbend_service.domain.maps import Float64

_HALO = (0, 0, 0)
HALO_OPACITY = 0.6
_SUBPIXEL_BITS = 4
#: OpenCV's coordinates are 32-bit with the sub-pixel bits in them; further out nothing is seen anyway.
_FARTHEST_PX = 1 << 24
_ANCHORS = {"start": "ls", "middle": "ms", "end": "rs"}


def rasterised(scene: Scene) -> Bytes:
    """(height, width, 3) uint8 rgb."""
    canvas = np.full((scene.height, scene.width, 3), 255, np.uint8)
    _draw(canvas, scene)
    return canvas


def text_width_px(text: str, size_px: float) -> float:
    """How wide a line of text is drawn."""
    return float(_font(size_px).getlength(text))


def halo_width_px(width_px: float) -> int:
    """How wide the dark ground of a curve is."""
    core = _whole(width_px)
    return core + 2 * max(1, core // 2)


def _draw(canvas: Bytes, scene: Scene) -> None:
    for item in scene.items:
        match item:
            case Raster():
                top, left = round(item.top), round(item.left)
                height, width = item.pixels.shape[:2]
                canvas[top : top + height, left : left + width] = item.pixels
            case Strokes():
                _draw_strokes(canvas, item)
            case Block():
                _fill(canvas, item)
            case Label():
                _write(canvas, item)
            case Placed():
                top, left = round(item.top), round(item.left)
                cut = np.ascontiguousarray(canvas[top : top + item.scene.height, left : left + item.scene.width])
                _draw(cut, item.scene)
                canvas[top : top + item.scene.height, left : left + item.scene.width] = cut


def _draw_strokes(canvas: Bytes, strokes: Strokes) -> None:
    """All halos lie under all cores, so that no halo cuts through another core."""
    families = [([_fixed(curve) for curve in curves], colour) for curves, colour in strokes.families]
    if strokes.halo:
        dark = canvas.copy()
        _lines(dark, [curve for curves, _ in families for curve in curves], _HALO, halo_width_px(strokes.width_px))
        cv2.addWeighted(dark, HALO_OPACITY, canvas, 1 - HALO_OPACITY, 0, dst=canvas)
    for curves, colour in families:
        _lines(canvas, curves, colour, _whole(strokes.width_px))


def _lines(canvas: Bytes, curves: Sequence[npt.NDArray[np.int32]], colour: tuple[int, int, int], width: int) -> None:
    cv2.polylines(canvas, list(curves), False, colour, width, cv2.LINE_AA, _SUBPIXEL_BITS)


def _fixed(curve: Float64) -> npt.NDArray[np.int32]:
    """OpenCV's pixels have their centres at whole numbers."""
    near = np.clip(curve - 0.5, -_FARTHEST_PX, _FARTHEST_PX)
    return (near * (1 << _SUBPIXEL_BITS)).round().astype(np.int32)


def _fill(canvas: Bytes, block: Block) -> None:
    top, left = round(block.top), round(block.left)
    part = canvas[top : round(block.top + block.height), left : round(block.left + block.width)]
    part[...] = (part * (1 - block.opacity) + np.array(block.colour) * block.opacity).round().astype(np.uint8)


def _write(canvas: Bytes, label: Label) -> None:
    font, anchor = _font(label.size_px), _ANCHORS[label.anchor]
    left, top, right, bottom = font.getbbox(label.text, anchor=anchor)
    x0, y0 = max(0, int(label.x + left) - 1), max(0, int(label.y + top) - 1)
    x1, y1 = min(canvas.shape[1], int(label.x + right) + 2), min(canvas.shape[0], int(label.y + bottom) + 2)
    if x1 <= x0 or y1 <= y0:
        return
    part = Image.fromarray(canvas[y0:y1, x0:x1])
    ImageDraw.Draw(part).text((label.x - x0, label.y - y0), label.text, label.colour, font, anchor=anchor)
    canvas[y0:y1, x0:x1] = np.asarray(part)


def _whole(width_px: float) -> int:
    return max(1, round(width_px))


@cache
def _font(size_px: float) -> ImageFont.FreeTypeFont:
    font = ImageFont.load_default(size=max(6.0, size_px))
    if not isinstance(font, ImageFont.FreeTypeFont):
        raise RuntimeError("Pillow was built without FreeType.")
    return font
