"""What stands about in rooms: each piece is drawn at a site, its back to the site's wall."""

from __future__ import annotations

import numpy as np

from training.vistas.materials import cloth, picture, plain, span, wood
from training.vistas.silhouettes import crockery, potted_plant
from training.vistas.sites import Site


def clutter(
    site: Site, s: tuple[float, float], t: float, out: tuple[float, float], count: int, rng: np.random.Generator
) -> None:
    """Small things on a board or a table: boxes, crockery, books, a plant."""
    for _ in range(count):
        here = site.moved(span(rng, *s), t, span(rng, *out), span(rng, -3, 3))
        kind, size = rng.random(), span(rng, 0.06, 0.3)
        if kind < 0.5:
            crockery(here, size, rng)
        elif kind < 0.85:
            half_s, half_out = span(rng, 0.02, 0.15), span(rng, 0.02, 0.12)
            here.box(
                (-half_s, half_s),
                (0, size),
                (-half_out, half_out),
                picture(rng) if rng.random() < 0.3 else plain(span(rng, 0, 1)),
            )
        else:
            potted_plant(here, size * 2, rng)


def table(site: Site, rng: np.random.Generator) -> None:
    """A table or desk with chairs, round or square, and what stands on it."""
    stuff, tall, long, deep = wood(rng, planks=False), span(rng, 0.4, 0.8), span(rng, 0.4, 1.0), span(rng, 0.3, 0.5)
    if rng.random() < 0.3:
        site.round(0, 0, [(deep + 0.2, tall - 0.03), (deep + 0.2, tall)], stuff, sides=28)
        site.round(0, 0, [(0.2, 0), (0.04, 0.1), (0.04, tall)], stuff, sides=10)
    else:
        site.box((-long, long), (tall - 0.04, tall), (-deep, deep), stuff)
        for s in (-long + 0.03, long - 0.08):
            for out in (-deep + 0.03, deep - 0.08):
                site.box((s, s + 0.05), (0, tall), (out, out + 0.05), stuff, 0.8)
    clutter(site, (-long * 0.6, long * 0.6), tall, (-deep * 0.6, deep * 0.6), int(rng.integers(0, 6)), rng)
    for _ in range(int(rng.integers(0, 5))):
        turn = span(rng, -np.pi, np.pi)
        chair(
            site.moved(
                1.3 * long * float(np.sin(turn)), 0, (deep + 0.4) * float(np.cos(turn)), turn + span(rng, -0.4, 0.4)
            ),
            rng,
        )


def chair(site: Site, rng: np.random.Generator) -> None:
    """Four legs, a seat and a back of bars or a board."""
    stuff, seat, back, half = (
        plain(span(rng, 0.02, 0.9)),
        span(rng, 0.42, 0.48),
        span(rng, 0.8, 1.1),
        span(rng, 0.18, 0.24),
    )
    site.box((-half, half), (seat - 0.04, seat), (-half, half), cloth(rng) if rng.random() < 0.3 else stuff)
    for s in (-half, half - 0.035):
        site.box((s, s + 0.035), (0, back), (-half, -half + 0.035), stuff)
        site.box((s, s + 0.035), (0, seat), (half - 0.035, half), stuff)
    if rng.random() < 0.5:
        site.box((-half, half), (seat + 0.15, back), (-half, -half + 0.03), stuff)
    else:
        for at in np.linspace(-half + 0.05, half - 0.05, int(rng.integers(3, 7))).tolist():
            site.box((at, at + 0.02), (seat, back), (-half, -half + 0.02), stuff)


def bed(site: Site, rng: np.random.Generator) -> None:
    """Mattress and blanket, pillows, head and foot."""
    half, long, tall = span(rng, 0.45, 0.95), span(rng, 1.9, 2.1), span(rng, 0.4, 0.7)
    frame, blanket = wood(rng, planks=False), cloth(rng)
    site.box((-half, half), (0.15, tall), (0.05, long), blanket)
    site.box((-half - 0.05, half + 0.05), (0, span(rng, 0.8, 1.3)), (0, 0.06), frame)
    if rng.random() < 0.5:
        site.box((-half - 0.05, half + 0.05), (0, tall + span(rng, 0, 0.3)), (long, long + 0.05), frame)
    for s in np.linspace(-half, half, int(rng.integers(2, 4)))[:-1].tolist():
        hump = site.moved(s + half * 0.5, tall - 0.02, 0.35)
        hump.round(0, 0, [(0.3, 0), (0.33, 0.06), (0.25, 0.14), (0.1, 0.18)], plain(span(rng, 0.4, 1)), sides=16)


def sofa(site: Site, rng: np.random.Generator) -> None:
    """A seat with arms, back and cushions."""
    half, stuff = span(rng, 0.4, 1.2), cloth(rng) if rng.random() < 0.5 else plain(span(rng, 0.05, 0.9))
    site.box((-half, half), (0.08, 0.42), (0, 0.85), stuff)
    site.box((-half, half), (0.3, span(rng, 0.75, 0.95)), (0, 0.22), stuff, 0.95)
    for s in (-half, half - 0.18):
        site.box((s, s + 0.18), (0.08, 0.6), (0, 0.85), stuff, 0.9)
    for _ in range(int(rng.integers(0, 4))):
        cushion = site.moved(span(rng, -half + 0.3, half - 0.3), 0.45, 0.3, span(rng, -0.5, 0.5))
        cushion.face([(-0.2, 0.36, -0.05), (0.2, 0.4, -0.05), (0.22, 0, 0.1), (-0.2, 0.02, 0.1)], cloth(rng))


def lamp(site: Site, height: float, rng: np.random.Generator) -> None:
    """A pendant, or a standard lamp."""
    shade = plain(span(rng, 0.6, 1.2))
    if rng.random() < 0.5:
        drop = span(rng, 0.3, 1.0)
        site.box((-0.005, 0.005), (height - drop, height), (-0.005, 0.005), plain(0.05))
        site.round(0, 0, [(span(rng, 0.1, 0.3), height - drop - 0.2), (0.05, height - drop)], shade, sides=18)
    else:
        tall = span(rng, 1.2, 1.7)
        site.round(0, 0, [(0.015, 0), (0.015, tall)], plain(0.1), sides=8)
        site.round(0, 0, [(0.25, tall), (0.12, tall + 0.3)], shade, sides=18)
