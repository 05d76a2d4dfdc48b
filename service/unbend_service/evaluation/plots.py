"""Line plots as SVG text: no plotting library, the same file for the same numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

_WIDTH, _HEIGHT = 520, 380
_LEFT, _RIGHT, _TOP, _BOTTOM = 58, 20, 40, 52
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
_TICKS = 5
_FONT = 'font-family="sans-serif" font-size="12"'


@dataclass(frozen=True)
class Line:
    """points: (x, y), drawn in their order. labels: a word beside each point, or none."""

    name: str
    points: Sequence[tuple[float, float]]
    labels: Sequence[str] = ()
    dashed: bool = False


def plot(title: str, x_name: str, y_name: str, lines: Sequence[Line], x_max: float, y_max: float) -> str:
    """An SVG of lines with markers over axes that begin at 0."""

    def across(x: float) -> float:
        return _LEFT + (_WIDTH - _LEFT - _RIGHT) * x / x_max

    def down(y: float) -> float:
        return _HEIGHT - _BOTTOM - (_HEIGHT - _TOP - _BOTTOM) * y / y_max

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" width="{_WIDTH}">',
        f'<rect width="{_WIDTH}" height="{_HEIGHT}" fill="white"/>',
        _text(_WIDTH / 2, 22, title, "middle", 14),
        _text((_LEFT + _WIDTH - _RIGHT) / 2, _HEIGHT - 12, x_name, "middle"),
        f'<g transform="rotate(-90 16 {_HEIGHT / 2})">{_text(16, _HEIGHT / 2, y_name, "middle")}</g>',
    ]
    for tick in range(_TICKS + 1):
        x, y = x_max * tick / _TICKS, y_max * tick / _TICKS
        parts.append(_stroke([(across(x), down(0)), (across(x), down(y_max))], "#dddddd"))
        parts.append(_stroke([(across(0), down(y)), (across(x_max), down(y))], "#dddddd"))
        parts.append(_text(across(x), down(0) + 18, f"{x:.2g}", "middle"))
        parts.append(_text(across(0) - 6, down(y) + 4, f"{y:.2g}", "end"))
    for number, line in enumerate(lines):
        colour = "#888888" if line.dashed else _COLOURS[number % len(_COLOURS)]
        spots = [(across(min(x, x_max)), down(min(y, y_max))) for x, y in line.points]
        parts.append(_stroke(spots, colour, 2, dashed=line.dashed))
        if not line.dashed:
            parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="{colour}"/>' for x, y in spots]
        parts += [_text(x + 6, y - 6, label, "start", 10) for (x, y), label in zip(spots, line.labels, strict=False)]
        parts.append(f'<rect x="{_LEFT + 10}" y="{_TOP + 6 + 17 * number}" width="14" height="4" fill="{colour}"/>')
        parts.append(_text(_LEFT + 30, _TOP + 12 + 17 * number, line.name, "start"))
    return "\n".join([*parts, "</svg>"]) + "\n"


def _text(x: float, y: float, words: str, anchor: str, size: int = 12) -> str:
    font = _FONT.replace("12", str(size))
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" {font}>{escape(words)}</text>'


def _stroke(points: Sequence[tuple[float, float]], colour: str, width: int = 1, *, dashed: bool = False) -> str:
    places = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    dashes = ' stroke-dasharray="5 4"' if dashed else ""
    return f'<polyline points="{places}" fill="none" stroke="{colour}" stroke-width="{width}"{dashes}/>'
