"""The legend of a displacement field."""

from __future__ import annotations

import cv2
import numpy as np

from unbend_service.application.ports import Bytes

_FONT = cv2.FONT_HERSHEY_SIMPLEX
_WHITE = (255, 255, 255)
_NICE = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
_SHADE = 0.35
#: A legend in a smaller picture would cover it.
_SMALLEST_PX = 200


def draw_legend(canvas: Bytes, longest_px: float, mean_px: float, factor: int, spacing_px: float) -> None:
    """Draws a panel with a scale bar and the figures into the lower left corner of (height, width, 3) ``canvas``.

    Args:
        longest_px, mean_px: displacement in pixels of the picture.
        factor: how many times longer than they are the arrows are drawn.
        spacing_px: distance of two arrows.
    """
    height, width = canvas.shape[:2]
    if min(height, width) < _SMALLEST_PX:
        return
    bar_px = max((n for n in _NICE if n * factor <= 2 * spacing_px), default=_NICE[0])
    drawn_times = f"arrows {factor}x as long" if factor > 1 else "arrows to scale"
    lines = [f"{bar_px:g} px, {drawn_times}", f"longest {longest_px:.1f} px, mean {mean_px:.1f} px"]
    scale = max(0.4, min(height, width) / 1100)
    thick = max(1, round(1.6 * scale))
    (_, text_height), baseline = cv2.getTextSize("Ag", _FONT, scale, thick)
    line_height = text_height + baseline + round(6 * scale)
    text_width = max(cv2.getTextSize(line, _FONT, scale, thick)[0][0] for line in lines)
    bar_width = round(bar_px * factor)
    margin = round(14 * scale)
    panel_width = max(text_width, bar_width) + 2 * margin
    panel_height = len(lines) * line_height + 3 * margin
    left, top = margin, height - margin - panel_height
    panel = canvas[top : top + panel_height, left : left + panel_width]
    panel[...] = (panel * _SHADE).astype(np.uint8)
    x, y = left + margin, top + margin + thick
    cv2.line(canvas, (x, y), (x + bar_width, y), _WHITE, 2 * thick, cv2.LINE_AA)
    for end in (x, x + bar_width):
        cv2.line(canvas, (end, y - margin // 2), (end, y + margin // 2), _WHITE, thick, cv2.LINE_AA)
    for i, line in enumerate(lines):
        baseline_y = y + margin // 2 + round((i + 0.9) * line_height)
        cv2.putText(canvas, line, (x, baseline_y), _FONT, scale, _WHITE, thick, cv2.LINE_AA)
