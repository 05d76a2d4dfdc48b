"""Legends: what a length or a colour of a figure means, in pixels of the picture."""

from __future__ import annotations

import cv2
import numpy as np

from unbend_service.adapters.drawing.rasters import text_width_px
from unbend_service.adapters.drawing.scene import Block, Item, Label, Raster, Scene, Strokes

_WHITE, _INK = (255, 255, 255), (20, 20, 20)
_NICE = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
_SHADE = 0.65
#: A legend in a smaller picture would cover it.
_SMALLEST_PX = 200
_BAR_STEPS = 5


def arrows_legend(
    width: int, height: int, longest_px: float, mean_px: float, factor: int, spacing_px: float
) -> list[Item]:
    """A panel with a scale bar and the figures, for the lower left corner of a picture.

    Args:
        width, height: of the picture; a small one gets no legend.
        longest_px, mean_px: displacement in pixels of the picture.
        factor: how many times longer than they are the arrows are drawn.
        spacing_px: distance of two arrows.
    """
    if min(height, width) < _SMALLEST_PX:
        return []
    bar_px = max((n for n in _NICE if n * factor <= 2 * spacing_px), default=_NICE[0])
    drawn_times = f"arrows {factor}× as long" if factor > 1 else "arrows to scale"
    lines = [f"{bar_px:g} px, {drawn_times}", f"longest {longest_px:.1f} px, mean {mean_px:.1f} px"]
    size = max(11.0, min(height, width) / 38)
    margin, line_height = 0.7 * size, 1.35 * size
    text_width = max(text_width_px(line, size) for line in lines)
    bar_width = bar_px * factor
    panel_width = max(text_width, bar_width) + 2 * margin
    panel_height = len(lines) * line_height + 2.4 * margin
    left, top = margin, height - margin - panel_height
    x, y = left + margin, top + margin
    thick = max(1, round(size / 12))
    tick = margin / 2
    bar = [np.array([[x, y], [x + bar_width, y]], dtype=np.float64)]
    bar += [np.array([[end, y - tick], [end, y + tick]], dtype=np.float64) for end in (x, x + bar_width)]
    items: list[Item] = [
        Block(left, top, panel_width, panel_height, (0, 0, 0), _SHADE),
        Strokes([(bar, _WHITE)], thick, halo=False),
    ]
    for i, line in enumerate(lines):
        items.append(Label(line, x, y + tick + (i + 0.85) * line_height, size, _WHITE))
    return items


def colours_legend(height: int, longest_px: float, colour_map: int) -> Scene:
    """A bar of the colours of lengths up to ``longest_px``, with their numbers in pixels, ``height`` pixels high."""
    size = max(11.0, height / 32)
    bar_width, tick = round(1.4 * size), 0.35 * size
    top, bottom = round(2.2 * size), round(height - size)
    left = round(0.9 * size)
    texts = [f"{longest_px * step / _BAR_STEPS:.{2 if longest_px < 5 else 1}f}" for step in range(_BAR_STEPS + 1)]
    widest = max(text_width_px(text, size) for text in texts)
    scene = Scene(round(left + bar_width + 2.2 * tick + widest + 0.6 * size), height)
    levels = np.linspace(255, 0, max(2, bottom - top)).astype(np.uint8)[:, None]
    colours = np.repeat(cv2.applyColorMap(levels, colour_map)[..., ::-1], bar_width, axis=1)
    scene.items.append(Raster(np.ascontiguousarray(colours), left, top))
    ticks = []
    for step, text in enumerate(texts):
        y = bottom - (bottom - top) * step / _BAR_STEPS
        ticks.append(np.array([[left + bar_width, y], [left + bar_width + tick, y]], dtype=np.float64))
        scene.items.append(Label(text, left + bar_width + 1.8 * tick, y + 0.35 * size, size, _INK))
    scene.items.append(Strokes([(ticks, _INK)], max(1, round(size / 14)), halo=False))
    scene.items.append(Label("px", left, top - 0.7 * size, size, _INK))
    return scene
