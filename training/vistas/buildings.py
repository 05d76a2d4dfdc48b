"""Fronts of town houses with their relief, and gabled houses, for drawn scenes out of doors."""

from __future__ import annotations

import numpy as np

from training.vistas.fittings import framed, reliefs
from training.vistas.grounds import railing
from training.vistas.materials import (
    OUTDOOR,
    Material,
    any_of,
    boards,
    picture,
    plain,
    span,
    tiles,
    wood,
)
from training.vistas.silhouettes import bush
from training.vistas.sites import Site


def opening(
    site: Site,
    s: tuple[float, float],
    t: tuple[float, float],
    depth: float,
    frame: Material,
    pane: Material,
    bars: tuple[int, int],
    arched: bool = False,
) -> None:
    """A window before the wall's plane: surround, glass, bars and a sill. Nothing is cut out of the wall."""
    width = min(0.14, (s[1] - s[0]) * 0.12)
    site.panel(s, t, 0.006, pane)
    for left in (s[0] - width, s[1]):
        site.box((left, left + width), (t[0], t[1] + width), (0, depth), frame)
    site.box(s, (t[1], t[1] + width), (0, depth), frame)
    site.box((s[0] - 1.5 * width, s[1] + 1.5 * width), (t[0] - 0.09, t[0]), (0, 2 * depth + 0.05), frame, 0.95)
    if arched:
        angles = np.linspace(np.pi, 0, 13)
        middle, radius = (s[0] + s[1]) / 2, (s[1] - s[0]) / 2
        for size, out, stuff in ((radius + width, depth, frame), (radius, depth + 0.002, pane)):
            bow = [(middle + size * float(np.cos(a)), t[1] + 0.7 * size * float(np.sin(a)), out) for a in angles]
            site.face(bow, stuff)
    columns, rows = bars
    for n in range(1, columns):
        at = s[0] + (s[1] - s[0]) * n / columns
        site.box((at - 0.03, at + 0.03), t, (0, 0.03), frame)
    for n in range(1, rows):
        at = t[0] + (t[1] - t[0]) * n / rows
        site.box(s, (at - 0.03, at + 0.03), (0, 0.03), frame)


def front(site: Site, length: float, storeys: int, rng: np.random.Generator) -> float:
    """A town house's front with rows of windows, ledges, balconies, perhaps a shop; returns its height."""
    wall, storey, ground_floor = any_of(OUTDOOR, rng), span(rng, 2.6, 3.8), span(rng, 3.0, 4.6)
    height = ground_floor + storeys * storey + span(rng, 0.3, 1.2)
    site.box((0, length), (0, height), (-9, 0), wall)
    trim = plain(span(rng, 0.15, 1))
    axes = max(1, int(length / span(rng, 1.9, 3.6)))
    pitch, depth = length / axes, span(rng, 0.03, 0.2)
    wide, tall, sill = pitch * span(rng, 0.35, 0.62), storey * span(rng, 0.45, 0.72), span(rng, 0.6, 1.0)
    bars = int(rng.integers(1, 4)), int(rng.integers(1, 5))
    glass = [plain(span(rng, 0.02, 0.35)), plain(span(rng, 0.05, 0.6)), Material(picture(rng).texture * 0.4, 1.0)]
    balconies, arched = rng.random() < 0.25, bool(rng.random() < 0.2)
    if rng.random() < 0.6:
        shop(site, length, ground_floor, rng)
    for floor in range(storeys):
        base = ground_floor + floor * storey
        for axis in range(axes):
            middle = (axis + 0.5) * pitch
            s, t = (middle - wide / 2, middle + wide / 2), (base + sill * 0.6, base + sill * 0.6 + tall)
            opening(site, s, t, depth, trim, glass[int(rng.integers(3))], bars, arched)
            if balconies and axis % 2 == floor % 2:
                railing(site.moved(s[0] - 0.3, base, 1.0), wide + 0.6, 1.0, trim, rng)
                site.box((s[0] - 0.3, s[1] + 0.3), (base - 0.12, base), (0, 1.0), trim)
    for level in [ground_floor - 0.2, height - 0.25] + [
        ground_floor + n * storey - 0.1 for n in range(1, storeys) if rng.random() < 0.4
    ]:
        step = span(rng, 0.05, 0.35)
        for n in range(int(rng.integers(1, 4))):
            site.box((0, length), (level + 0.09 * n, level + 0.09 * n + 0.07), (0, step * (n + 1) / 2), trim)
    if rng.random() < 0.4:
        for axis in range(axes + 1):
            site.box((axis * pitch - 0.15, axis * pitch + 0.15), (0, height), (0, 0.1), wall, 0.92)
    if rng.random() < 0.4:
        at = span(rng, 0, length)
        site.round(at, 0.1, [(0.06, 0), (0.06, height)], trim, sides=8)
    return height


def shop(site: Site, length: float, height: float, rng: np.random.Generator) -> None:
    """Panes of a shop with a sign above, and perhaps an awning."""
    trim, at = plain(span(rng, 0.05, 0.9)), span(rng, 0.2, 0.8)
    while at < length - 1.5:
        wide = min(span(rng, 1.2, 3), length - at - 0.2)
        framed(site, (at, at + wide), (0.0 if rng.random() < 0.3 else 0.5, height * 0.68), picture(rng), rng)
        at += wide + span(rng, 0.15, 1.0)
    site.box((0.2, length - 0.2), (height * 0.72, height * 0.9), (0, 0.12), trim)
    site.panel((0.2, length - 0.2), (height * 0.72, height * 0.9), 0.125, picture(rng))
    if rng.random() < 0.35:
        reach, low, high = span(rng, 0.7, 1.6), height * 0.55, height * 0.72
        stripes = Material(
            np.asarray(np.sign(np.sin(np.arange(256) * 0.2))[None, :].repeat(256, 0) * 0.25 + 0.5, np.float32), 2.0
        )
        site.face([(0.3, high, 0), (length - 0.3, high, 0), (length - 0.3, low, reach), (0.3, low, reach)], stripes)


def house(site: Site, wide: float, deep: float, rng: np.random.Generator) -> None:
    """A gabled house: slanting edges above, windows, doors, a garage, a porch, a chimney."""
    wall, roof = (
        boards(rng) if rng.random() < 0.5 else any_of(OUTDOOR, rng),
        tiles(rng) if rng.random() < 0.6 else boards(rng),
    )
    eaves, rise, lap = span(rng, 2.4, 5.5), span(rng, 0.8, 3.5), span(rng, 0.2, 0.7)
    trim = plain(span(rng, 0.2, 1))
    site.box((0, wide), (0, eaves), (-deep, 0), wall)
    if rng.random() < 0.5:  # the ridge runs along the front
        for out in (0.0, -deep):
            lower = lap if out == 0.0 else -lap
            site.face(
                [
                    (-lap, eaves + rise, -deep / 2),
                    (wide + lap, eaves + rise, -deep / 2),
                    (wide + lap, eaves - 0.1, out + lower),
                    (-lap, eaves - 0.1, out + lower),
                ],
                roof,
            )
        for s in (0.0, wide):
            site.face([(s, eaves, -deep), (s, eaves + rise, -deep / 2), (s, eaves, 0)], wall)
        site.box((-lap, wide + lap), (eaves - 0.22, eaves - 0.08), (lap, lap + 0.06), trim)
    else:
        middle = wide / 2
        for left, right in ((-lap, middle), (wide + lap, middle)):
            site.face(
                [
                    (left, eaves - 0.1, -deep - lap),
                    (right, eaves + rise, -deep - lap),
                    (right, eaves + rise, lap),
                    (left, eaves - 0.1, lap),
                ],
                roof,
            )
            site.face(
                [
                    (left, eaves - 0.1, lap),
                    (right, eaves + rise, lap),
                    (right, eaves + rise - 0.2, lap),
                    (left, eaves - 0.3, lap),
                ],
                trim,
            )
        site.face([(0, eaves, 0.0), (middle, eaves + rise, 0.0), (wide, eaves, 0.0)], wall)
    pane, bars = plain(span(rng, 0.02, 0.5)), (int(rng.integers(1, 4)), int(rng.integers(1, 4)))
    at = span(rng, 0.5, 1.2)
    while at < wide - 1.2:
        kind, room = rng.random(), min(span(rng, 0.8, 2.4), wide - at - 0.4)
        if kind < 0.2 and room > 0.8:
            site.box((at, at + 0.95), (0, 2.05), (0, 0.04), plain(span(rng, 0.05, 1)))
            reliefs(site, (at, at + 0.95), (0, 2.05), 0.045, 1, 3, wood(rng, planks=False), rng)
        elif kind < 0.35 and wide - at > 3.2:
            site.box((at, at + 2.6), (0, 2.15), (0, 0.03), trim)
            for row in range(4):
                reliefs(site, (at, at + 2.6), (row * 0.52, row * 0.52 + 0.5), 0.03, 4, 1, trim, rng)
            room = 2.7
        else:
            for base in (0.9, 3.6):
                if base + 1.2 < eaves:
                    opening(site, (at, at + room), (base, base + span(rng, 0.9, 1.4)), 0.06, trim, pane, bars)
        at += room + span(rng, 0.4, 2)
    if rng.random() < 0.4:
        reach, top = span(rng, 1, 2.4), min(eaves, 2.6)
        site.box((0, wide), (top, top + 0.18), (0, reach), trim)
        for s in np.linspace(0.2, wide - 0.3, int(rng.integers(2, 6))).tolist():
            site.box((s, s + 0.14), (0, top), (reach - 0.2, reach - 0.06), trim)
    if rng.random() < 0.5:
        s = span(rng, 0.3, wide - 0.8)
        site.box((s, s + 0.6), (eaves, eaves + rise + 0.8), (-deep / 2 - 0.6, -deep / 2), tiles(rng))
    for _ in range(int(rng.integers(0, 6))):
        bush(site.moved(span(rng, 0, wide), 0, span(rng, 0.3, 1.2)), span(rng, 0.4, 1.1), rng)
