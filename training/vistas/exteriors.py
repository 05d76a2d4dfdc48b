"""Streets, gardens and stairs of drawn scenes."""

from __future__ import annotations

import math

import numpy as np

from training.vistas import buildings, grounds
from training.vistas.materials import FLOORS, any_of, ground, plain, span
from training.vistas.raster import Raster
from training.vistas.silhouettes import bush, car, people, tree
from training.vistas.sites import Site


def suburb(raster: Raster, rng: np.random.Generator) -> None:
    """Gabled houses behind lawns, fences, trees, cars."""
    road = Site.facing(raster, (0.0, 0.0, span(rng, 2, 7)), math.pi)
    if rng.random() < 0.6:
        grounds.street(road, 40, span(rng, 3, 7), rng)
    else:
        road.face([(-60, 0, -60), (60, 0, -60), (60, 0, 60), (-60, 0, 60)], ground(rng))
    if rng.random() < 0.35:
        grounds.path(Site.facing(raster, (span(rng, -3, 2), 0.0, 0.0), math.pi), span(rng, 0.8, 3), rng)
    x = -span(rng, 5, 14)
    while x < 12:
        wide, front = span(rng, 5, 13), span(rng, 7, 16)
        buildings.house(
            Site.facing(raster, (x, 0.0, front), math.pi + (float(rng.normal()) * 0.2 if rng.random() < 0.4 else 0.0)),
            wide,
            span(rng, 5, 9),
            rng,
        )
        x += wide + span(rng, 1, 6)
    if rng.random() < 0.6:
        grounds.fence(
            Site.facing(raster, (-span(rng, 2, 12), 0.0, span(rng, 4, 8)), math.pi + span(rng, -0.3, 0.3)),
            span(rng, 4, 16),
            rng,
        )
    _outdoors(raster, rng, trees=int(rng.integers(0, 5)))


def fronts(raster: Raster, rng: np.random.Generator) -> None:
    """Town houses across the street."""
    distance, x = span(rng, 5, 16), -span(rng, 6, 22)
    road = Site.facing(raster, (0.0, 0.0, distance - span(rng, 1.5, 4)), math.pi)
    grounds.street(road, 40, span(rng, 3, 8), rng)
    while x < 18:
        wide = span(rng, 5, 16)
        buildings.front(
            Site.facing(raster, (x, 0.0, distance + span(rng, 0, 0.4)), math.pi), wide, int(rng.integers(1, 6)), rng
        )
        x += wide + (span(rng, 0, 3) if rng.random() < 0.2 else 0.0)
    _outdoors(raster, rng, trees=int(rng.integers(0, 3)))


def canyon(raster: Raster, rng: np.random.Generator) -> None:
    """Along a street between town houses."""
    half = span(rng, 3, 9)
    road = Site.facing(raster, (half * 0.6, 0.0, 0.0), -math.pi / 2)
    grounds.street(road, 60, half * 1.2, rng)
    for bearing, side in ((math.pi / 2, -1.0), (-math.pi / 2, 1.0)):
        z = -span(rng, 0, 4)
        while z < 30:
            wide = span(rng, 6, 16)
            start = z if side < 0 else z + wide
            buildings.front(Site.facing(raster, (side * half, 0.0, start), bearing), wide, int(rng.integers(1, 6)), rng)
            z += wide + (span(rng, 0, 5) if rng.random() < 0.25 else 0.0)
    _outdoors(raster, rng, trees=int(rng.integers(0, 4)), beside=half * 0.8)


def steps(raster: Raster, rng: np.random.Generator) -> None:
    """Stairs, walls and railings, close by."""
    floor = Site.facing(raster, (0.0, 0.0, 0.0), math.pi)
    floor.face([(-60, 0, -60), (60, 0, -60), (60, 0, 60), (-60, 0, 60)], any_of(FLOORS, rng))
    distance = span(rng, 2.5, 7)
    wall = Site.facing(raster, (-12.0, 0.0, distance + span(rng, 2, 4)), math.pi + float(rng.normal()) * 0.1)
    buildings.front(wall, 26, int(rng.integers(1, 4)), rng)
    for _ in range(int(rng.integers(1, 4))):
        place = Site.facing(
            raster,
            (span(rng, -4, 3), 0.0, distance),
            math.pi + float(rng.choice([0, 0.5, 1.57, -1.57]) * (1 + 0.1 * rng.normal())),
        )
        grounds.stairs(place, span(rng, 1, 4), int(rng.integers(3, 14)), rng)
    for _ in range(int(rng.integers(0, 3))):
        place = Site.facing(raster, (span(rng, -5, 5), 0.0, span(rng, 2, distance)), math.pi + span(rng, -0.8, 0.8))
        grounds.railing(place, span(rng, 2, 6), span(rng, 0.8, 1.2), plain(span(rng, 0, 1)), rng)
    _outdoors(raster, rng, trees=int(rng.integers(0, 2)))


def _outdoors(raster: Raster, rng: np.random.Generator, trees: int, beside: float | None = None) -> None:
    """Trees, bushes, cars, posts and people."""

    def somewhere(near: float, far: float) -> Site:
        z = span(rng, near, far)
        x = span(rng, -z, z) if beside is None else float(rng.choice([-1, 1])) * beside
        return Site.facing(raster, (x, 0.0, z), math.pi)

    for _ in range(trees):
        tree(somewhere(4, 18), span(rng, 3, 11), rng)
    for _ in range(int(rng.integers(0, 4))):
        bush(somewhere(3, 12), span(rng, 0.3, 1.4), rng)
    for _ in range(int(rng.integers(0, 4))):
        grounds.pole(somewhere(2.5, 15), rng)
    if rng.random() < 0.4:
        grounds.wires(somewhere(4, 14).moved(0, 0, 0, span(rng, -1, 1)), span(rng, 10, 40), rng)
    for _ in range(int(rng.integers(0, 3))):
        place, long = somewhere(4, 14), span(rng, 3.6, 4.8)
        place.panel((-long / 2, long / 2), (0, long / 2.6), 0.0, car(rng))
    people(raster, (-6, 6), (2.5, 14), int(rng.integers(0, 6)), rng)
