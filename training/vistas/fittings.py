"""What is fixed to walls or stands against them: each piece is drawn at the site that the wall is."""

from __future__ import annotations

import numpy as np

from training.vistas.furniture import clutter
from training.vistas.materials import INDOOR, Material, any_of, cloth, picture, plain, span, tiles, wood
from training.vistas.silhouettes import foliage
from training.vistas.sites import Site


def skirting(site: Site, length: float, height: float, rng: np.random.Generator) -> None:
    """Boards where a wall meets floor and ceiling."""
    board = plain(span(rng, 0.1, 1))
    if rng.random() < 0.7:
        site.box((0, length), (0, span(rng, 0.06, 0.16)), (0, 0.02), board)
    if rng.random() < 0.35:
        drop = span(rng, 0.04, 0.15)
        site.box((0, length), (height - drop, height), (0, drop * 0.7), board)


def framed(
    site: Site, s: tuple[float, float], t: tuple[float, float], inner: Material, rng: np.random.Generator
) -> None:
    """A frame of four bars around a picture, mirror or screen."""
    width, depth, bar = span(rng, 0.01, 0.08), span(rng, 0.01, 0.05), plain(span(rng, 0.02, 1))
    site.panel(s, t, 0.008, inner)
    for left, right in ((s[0], s[0] + width), (s[1] - width, s[1])):
        site.box((left, right), t, (0, depth), bar)
    for low, high in ((t[0], t[0] + width), (t[1] - width, t[1])):
        site.box(s, (low, high), (0, depth), bar)


def disc(site: Site, s: float, t: float, radius: float, stuff: Material) -> None:
    """A clock, a plate, a round mirror: a rim and what is in it."""
    for out, size, tone in ((0.01, radius, 0.5), (0.015, radius * 0.88, 1.0)):
        angles = np.linspace(0, 2 * np.pi, 36, endpoint=False)
        outline = np.stack([s + size * np.sin(angles), t + size * np.cos(angles), np.full(36, out)], 1)
        site.face([tuple(corner) for corner in outline.tolist()], stuff, tone)


def window(site: Site, s: tuple[float, float], t: tuple[float, float], rng: np.random.Generator) -> None:
    """Casing, sashes, a sill, what is seen through it, and often curtains or blinds."""
    view = foliage(rng).texture if rng.random() < 0.5 else picture(rng).texture
    bright = span(rng, 0.2, 1.0)
    framed(site, s, t, Material(np.asarray(view * 0.4 + bright * 0.6, np.float32), 1.0), rng)
    bar, half = plain(span(rng, 0.1, 1)), span(rng, 0.008, 0.025)
    columns, rows = int(rng.integers(1, 5)), int(rng.integers(1, 5))
    for n in range(1, columns):
        at = s[0] + (s[1] - s[0]) * n / columns
        site.box((at - half, at + half), t, (0, 0.025), bar)
    for n in range(1, rows):
        at = t[0] + (t[1] - t[0]) * n / rows
        site.box(s, (at - half, at + half), (0, 0.025), bar)
    site.box((s[0] - 0.06, s[1] + 0.06), (t[0] - 0.04, t[0]), (0, span(rng, 0.04, 0.2)), bar)
    dress = rng.random()
    if dress < 0.3:
        slat, pitch = plain(span(rng, 0.4, 1)), span(rng, 0.025, 0.06)
        bottom = t[0] + (t[1] - t[0]) * span(rng, 0, 0.7)
        for at in np.arange(bottom, t[1], pitch).tolist():
            site.box((s[0] + 0.02, s[1] - 0.02), (at, at + pitch * 0.45), (0.03, 0.05), slat)
    elif dress < 0.65:
        curtains(site, s, t, rng)


def curtains(site: Site, s: tuple[float, float], t: tuple[float, float], rng: np.random.Generator) -> None:
    """Cloth in folds that are upright above and wander below, beside a window."""
    stuff, wide = cloth(rng), (s[1] - s[0]) * span(rng, 0.15, 0.5)
    top, bottom = t[1] + span(rng, 0, 0.25), span(rng, 0, t[0]) if rng.random() < 0.5 else t[0] - 0.1
    site.box((s[0] - wide, s[1] + wide), (top - 0.03, top), (0.06, 0.09), plain(span(rng, 0.05, 1)))
    for start in (s[0] - wide, s[1]):
        folds = int(rng.integers(4, 12))
        above = np.linspace(start, start + wide, folds + 1)
        below = above + rng.normal(0, wide * 0.05, folds + 1)
        for n in range(folds):
            depth = (0.06, 0.11) if n % 2 else (0.11, 0.06)
            corners = [
                (float(above[n]), top, depth[0]),
                (float(above[n + 1]), top, depth[1]),
                (float(below[n + 1]), bottom, depth[1]),
                (float(below[n]), bottom, depth[0]),
            ]
            site.face(corners, stuff, 1.0 if n % 2 else 0.8)


def door(site: Site, s: float, height: float, rng: np.random.Generator) -> None:
    """A leaf with panels, its casing and handle."""
    wide, casing = span(rng, 0.7, 1.0), span(rng, 0.05, 0.12)
    leaf, frame = (
        (wood(rng, planks=False), plain(span(rng, 0.2, 1))) if rng.random() < 0.5 else (plain(span(rng, 0.1, 1)),) * 2
    )
    top = min(span(rng, 1.95, 2.15), height - 0.1)
    site.box((s, s + wide), (0, top), (0, 0.02), leaf)
    for left in (s - casing, s + wide):
        site.box((left, left + casing), (0, top), (0, 0.04), frame, 0.9)
    site.box((s - casing, s + wide + casing), (top, top + casing), (0, 0.04), frame, 0.9)
    reliefs(site, (s, s + wide), (0, top), 0.02, int(rng.integers(1, 3)), int(rng.integers(1, 4)), leaf, rng)
    site.round(s + wide * 0.9, 0.07, [(0.03, 0.98), (0.03, 1.04)], plain(span(rng, 0, 1)), sides=10)


def reliefs(
    site: Site,
    s: tuple[float, float],
    t: tuple[float, float],
    out: float,
    columns: int,
    rows: int,
    stuff: Material,
    rng: np.random.Generator,
) -> None:
    """Fields on a door or a drawer front: each a shade darker or lighter, with its moulding."""
    margin = min(s[1] - s[0], t[1] - t[0]) * span(rng, 0.06, 0.2) / max(columns, rows)
    shade = span(rng, 0.6, 1.3)
    for column in range(columns):
        for row in range(rows):
            left, right = (s[0] + (s[1] - s[0]) * n / columns for n in (column, column + 1))
            low, high = (t[0] + (t[1] - t[0]) * n / rows for n in (row, row + 1))
            site.panel((left + margin, right - margin), (low + margin, high - margin), out + 0.001, stuff, shade)
            site.panel(
                (left + 1.5 * margin, right - 1.5 * margin),
                (low + 1.5 * margin, high - 1.5 * margin),
                out + 0.002,
                stuff,
            )


def cabinets(site: Site, length: float, height: float, rng: np.random.Generator) -> None:
    """A kitchen's row: cupboards, a worktop with things on it, wall tiles, cupboards above, a stove or a fridge."""
    front, top, depth = (
        wood(rng, planks=False) if rng.random() < 0.6 else plain(span(rng, 0.1, 1)),
        any_of(INDOOR, rng),
        span(rng, 0.5, 0.65),
    )
    handle = plain(span(rng, 0, 1))
    panels, upper = bool(rng.random() < 0.7), bool(rng.random() < 0.8)
    site.panel((0, length), (0.9, 1.4), 0.004, Material(tiles(rng).texture, 1.0))
    at = 0.0
    while at < length - 0.3:
        wide = min(span(rng, 0.35, 0.7), length - at)
        kind = rng.random()
        if kind < 0.12:
            tall = span(rng, 1.5, 1.9)
            site.box((at, at + wide), (0, tall), (0, depth + 0.05), plain(span(rng, 0.1, 1)))
            site.box((at + 0.02, at + wide - 0.02), (tall * 0.66, tall * 0.665), (0, depth + 0.06), plain(0.05))
            site.box((at + 0.05, at + 0.07), (tall * 0.3, tall * 0.6), (depth, depth + 0.1), handle)
            at += wide
            continue
        site.box((at, at + wide), (0.1, 0.88), (0, depth), front)
        _front(
            site,
            (at + 0.01, at + wide - 0.01),
            (0.11, 0.7 if rng.random() < 0.6 else 0.87),
            depth,
            front,
            handle,
            panels,
            rng,
        )
        site.box((at + wide - 0.006, at + wide), (0.1, 0.88), (0, depth + 0.002), plain(0.05))
        if kind < 0.25:
            site.panel((at + 0.05, at + wide - 0.05), (0.25, 0.68), depth + 0.003, plain(span(rng, 0, 0.3)))
        if upper and kind > 0.2:
            site.box((at, at + wide), (1.4, min(2.2, height)), (0, 0.33), front)
            _front(site, (at + 0.01, at + wide - 0.01), (1.41, min(2.19, height)), 0.33, front, handle, panels, rng)
        at += wide
    site.box((0, length), (0.88, 0.92), (0, depth + 0.03), top)
    clutter(site, (0.1, length - 0.1), 0.92, (0.1, depth - 0.1), int(rng.integers(0, 9)), rng)


def _front(
    site: Site,
    s: tuple[float, float],
    t: tuple[float, float],
    out: float,
    stuff: Material,
    handle: Material,
    panelled: bool,
    rng: np.random.Generator,
) -> None:
    site.panel(s, t, out + 0.002, stuff, 1.08)
    if panelled:
        reliefs(site, s, t, out + 0.004, 1, 1, stuff, rng)
    at = s[0] + (s[1] - s[0]) * (0.1 if rng.random() < 0.5 else 0.85)
    middle = (t[0] + t[1]) / 2
    site.box((at, at + 0.02), (middle - 0.06, middle + 0.06), (out, out + 0.04), handle)


def shelf(site: Site, length: float, height: float, rng: np.random.Generator) -> None:
    """Boards with books, boxes and goods of all widths between two uprights."""
    stuff, depth, boards = any_of(INDOOR, rng), span(rng, 0.2, 0.45), int(rng.integers(2, 7))
    for left in (0.0, length - 0.03):
        site.box((left, left + 0.03), (0, height), (0, depth), stuff)
    if rng.random() < 0.6:
        site.panel((0, length), (0, height), 0.01, stuff, 0.6)
    gap = height / boards
    goods = [picture(rng) for _ in range(2)]
    for board in range(boards + 1):
        site.box((0, length), (board * gap, board * gap + 0.025), (0, depth), stuff, 0.95)
        if board == boards:
            break
        at, fill, tidy = 0.04, span(rng, 0.3, 1), bool(rng.random() < 0.6)
        while at < length - 0.1:
            wide = span(rng, 0.025, 0.09) if tidy else span(rng, 0.06, 0.25)
            tall = gap * span(rng, 0.4, 0.85)
            if rng.random() < fill:
                label = goods[int(rng.integers(2))] if rng.random() < 0.15 else plain(span(rng, 0, 1))
                site.box(
                    (at, at + wide - 0.003),
                    (board * gap + 0.025, board * gap + tall),
                    (0.02, depth * span(rng, 0.6, 0.95)),
                    label,
                )
            at += wide
