"""What stands and lies between houses: streets, ways, stairs, fences, poles and cables, and the sky."""

from __future__ import annotations

import itertools
import math

import cv2
import numpy as np
import numpy.typing as npt

from training.vistas.materials import (
    OUTDOOR,
    Material,
    any_of,
    ground,
    noise,
    picture,
    plain,
    span,
    tiles,
)
from training.vistas.sites import Site


def railing(site: Site, length: float, height: float, bar: Material, rng: np.random.Generator) -> None:
    """A rail on upright bars."""
    site.box((0, length), (height - 0.05, height), (-0.02, 0.02), bar)
    site.box((0, length), (0.08, 0.11), (-0.015, 0.015), bar)
    for at in np.arange(0, length, max(0.11, length / 24)).tolist():
        site.box((at, at + 0.02), (0, height), (-0.01, 0.01), bar)


def fence(site: Site, length: float, rng: np.random.Generator) -> None:
    """Pickets, boards, wires on posts, or a wall."""
    kind, height = int(rng.integers(4)), span(rng, 0.7, 1.9)
    stuff = plain(span(rng, 0.05, 1))
    if kind == 0:
        site.box((0, length), (0, height), (-0.1, 0.1), tiles(rng))
        return
    for at in np.arange(0, length, 2.2).tolist():
        site.box((at - 0.05, at + 0.05), (0, height + 0.1), (-0.1, 0), stuff)
    levels = np.linspace(0.25, height - 0.1, 2 if kind < 3 else int(rng.integers(3, 7))).tolist()
    for level in levels:
        site.box((0, length), (level, level + (0.08 if kind < 3 else 0.012)), (-0.04, 0), stuff)
    if kind < 3:
        pitch = span(rng, 0.11, 0.25)
        for n, at in enumerate(np.arange(0, length, pitch).tolist()):
            if n < 160:
                site.box((at, at + pitch * 0.6), (0.05, height), (0, 0.02), stuff, 0.95)


def stairs(site: Site, wide: float, steps: int, rng: np.random.Generator) -> None:
    """Steps that rise away from the front, with a railing on one side."""
    stuff, rise, tread = any_of(OUTDOOR, rng), span(rng, 0.14, 0.19), span(rng, 0.25, 0.34)
    for n in range(steps):
        site.box((0, wide), (n * rise, (n + 1) * rise), (-steps * tread, -n * tread), stuff, 1.0)
        site.box((0, wide), ((n + 1) * rise - 0.02, (n + 1) * rise), (-(n + 1) * tread, -n * tread + 0.02), stuff, 1.15)
    bar = plain(span(rng, 0, 0.9))
    for n in range(0, steps, 2):
        site.box((wide - 0.06, wide - 0.02), (n * rise, n * rise + 1.0), (-n * tread - 0.04, -n * tread), bar)
    high, far = steps * rise, -steps * tread
    site.face(
        [
            (wide - 0.02, 1.0, 0),
            (wide - 0.02, high + 1.0, far),
            (wide - 0.02, high + 0.93, far),
            (wide - 0.02, 0.93, 0),
        ],
        bar,
    )


def pole(site: Site, rng: np.random.Generator) -> None:
    """A lamp, a traffic sign or a plain post."""
    stuff, tall = plain(span(rng, 0.05, 0.8)), span(rng, 2.2, 8)
    site.round(0, 0, [(0.07, 0), (0.045, tall)], stuff, sides=8)
    kind = rng.random()
    if kind < 0.35:
        site.box((0, span(rng, 0.6, 2)), (tall - 0.08, tall), (-0.04, 0.04), stuff)
    elif kind < 0.7:
        half = span(rng, 0.2, 0.5)
        sign = picture(rng)
        if rng.random() < 0.5:
            site.panel((-half, half), (2.0, 2.0 + 2 * half), 0.08, sign)
        else:
            y, x = np.mgrid[-1:1:256j, -1:1:256j]
            site.panel(
                (-half, half),
                (2.0, 2.0 + 2 * half),
                0.08,
                Material(sign.texture, 1.0, (np.hypot(x, y) < 0.97).astype(np.float32)),
            )


def wires(site: Site, long: float, rng: np.random.Generator) -> None:
    """Cables that sag between two poles `long` metres apart."""
    high, dark = span(rng, 4, 8), plain(span(rng, 0, 0.3))
    for n in range(int(rng.integers(1, 5))):
        sag, level, thick, out = span(rng, 0.1, 1.5), high - 0.35 * n, span(rng, 0.01, 0.03), span(rng, -0.5, 0.5)
        places = np.linspace(-1, 1, 25)
        points = [(float(u) * long / 2, level - sag * (1 - float(u) ** 2), out) for u in places]
        for (s0, t0, _), (s1, t1, _) in itertools.pairwise(points):
            site.face([(s0, t0, out), (s1, t1, out), (s1, t1 - thick, out), (s0, t0 - thick, out)], dark)


def path(site: Site, wide: float, rng: np.random.Generator) -> None:
    """A way that winds ahead over the ground."""
    stuff, bend, phase = ground(rng), span(rng, 0.5, 4), span(rng, 0, 6)
    ahead = np.linspace(0.5, 25, 40)
    middle = bend * (np.sin(ahead * span(rng, 0.1, 0.4) + phase) - math.sin(phase))
    for n in range(len(ahead) - 1):
        (a, b), (x, y) = (-float(v) for v in ahead[n : n + 2]), (float(v) for v in middle[n : n + 2])
        site.face([(y, 0.006, b), (y + wide, 0.006, b), (x + wide, 0.006, a), (x, 0.006, a)], stuff)


def street(site: Site, long: float, wide: float, rng: np.random.Generator) -> None:
    """A roadway along s from `-long` to `long`, as wide as `out`, with kerbs, lines and a pavement on each side."""
    asphalt, paving, line = ground(rng), tiles(rng) if rng.random() < 0.7 else ground(rng), plain(span(rng, 0.6, 1))
    far = 60.0
    site.face(
        [(-far, 0, -far), (far, 0, -far), (far, 0, far), (-far, 0, far)], ground(rng) if rng.random() < 0.6 else paving
    )
    site.face([(-long, 0.004, 0), (long, 0.004, 0), (long, 0.004, wide), (-long, 0.004, wide)], asphalt)
    for edge, side in ((0.0, -1.0), (wide, 1.0)):
        other = edge + side * span(rng, 1, 4)
        low, high = min(edge, other), max(edge, other)
        site.box((-long, long), (0, 0.13), (low, high), paving)
        site.box((-long, long), (0, 0.135), (edge - 0.1, edge + 0.1), plain(span(rng, 0.3, 0.9)))
    if rng.random() < 0.7:
        dash, gap = span(rng, 1, 4), span(rng, 0, 4)
        for at in np.arange(-long, long, dash + gap + 0.5).tolist():
            site.face(
                [
                    (at, 0.008, wide / 2 - 0.07),
                    (at + dash, 0.008, wide / 2 - 0.07),
                    (at + dash, 0.008, wide / 2 + 0.07),
                    (at, 0.008, wide / 2 + 0.07),
                ],
                line,
            )
    if rng.random() < 0.3:
        at = span(rng, -8, 8)
        for n in np.arange(0.3, wide - 0.4, 0.9).tolist():
            site.face([(at, 0.009, n), (at + 3, 0.009, n), (at + 3, 0.009, n + 0.45), (at, 0.009, n + 0.45)], line)


def sky(rng: np.random.Generator, rows: int, columns: int, horizon: float) -> npt.NDArray[np.float32]:
    """Brighter or darker towards the horizon, clear, cloudy or overcast; float32 (rows, columns)."""
    down = np.arange(rows, dtype=np.float32)[:, None] / max(horizon, 1.0)
    zenith, haze = rng.uniform(0.3, 1.0), rng.uniform(0.5, 1.0)
    clouds = np.asarray(
        cv2.resize(noise(12, rng, 2) * noise(4, rng), (columns, rows), interpolation=cv2.INTER_CUBIC), np.float32
    )
    return np.asarray(
        zenith + (haze - zenith) * down.clip(0, 1) + clouds * rng.uniform(0, 0.6) * (rng.random() < 0.7), np.float32
    )
