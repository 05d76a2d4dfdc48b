"""Rooms of drawn scenes, around a camera that stands near their back wall."""

from __future__ import annotations

import math

import numpy as np

from training.vistas import fittings, furniture
from training.vistas.materials import FLOORS, INDOOR, any_of, picture, plain, span
from training.vistas.raster import Raster
from training.vistas.silhouettes import people, potted_plant
from training.vistas.sites import Site


def _room(raster: Raster, rng: np.random.Generator, half: float, depth: float, height: float) -> list[Site]:
    """Floor, ceiling and walls around the camera, which stands near the back; the walls as sites: left, far, right."""
    back = -span(rng, 0.6, 1.5)
    floor, ceiling = any_of(FLOORS, rng), any_of(INDOOR[:3], rng)
    centre = Site.facing(raster, (0.0, 0.0, 0.0), math.pi)
    centre.face([(-half, 0, -depth), (half, 0, -depth), (half, 0, -back), (-half, 0, -back)], floor)
    centre.face(
        [(-half, height, -back), (half, height, -back), (half, height, -depth), (-half, height, -depth)], ceiling
    )
    walls = [
        Site.facing(raster, (-half, 0.0, back), math.pi / 2),
        Site.facing(raster, (-half, 0.0, depth), math.pi),
        Site.facing(raster, (half, 0.0, depth), -math.pi / 2),
    ]
    same = any_of(INDOOR, rng)
    for wall, length in zip(walls, (depth - back, 2 * half, depth - back), strict=True):
        stuff = same if rng.random() < 0.75 else any_of(INDOOR, rng)
        wall.face([(0, height, 0), (length, height, 0), (length, 0, 0), (0, 0, 0)], stuff)
        fittings.skirting(wall, length, height, rng)
    if rng.random() < 0.3:
        for z in np.arange(1.0, depth, span(rng, 0.8, 2)).tolist():
            centre.box((-half, half), (height - 0.18, height), (-z - 0.12, -z), plain(span(rng, 0.1, 1)))
    for _ in range(int(rng.integers(0, 5))):
        s, out = span(rng, -half * 0.8, half * 0.8), -span(rng, 0.5, depth - 0.3)
        if rng.random() < 0.5:
            furniture.lamp(centre.moved(s, 0, out), height, rng)
        else:
            centre.box((s - 0.3, s + 0.3), (height - 0.03, height), (out - 0.6, out + 0.6), plain(1.3))
    return walls


def _hung(wall: Site, length: float, height: float, rng: np.random.Generator) -> None:
    """Doors, windows, pictures and shelves along a wall."""
    at = span(rng, 0.1, 1.0)
    while at < length - 1.0:
        kind, wide = rng.random(), min(span(rng, 0.5, 2.4), length - at - 0.2)
        if kind < 0.25:
            window_base = span(rng, 0.4, 1.1)
            fittings.window(
                wall, (at, at + wide), (window_base, min(height - 0.2, window_base + span(rng, 0.8, 1.6))), rng
            )
        elif kind < 0.4:
            fittings.door(wall, at, height, rng)
            wide = max(wide, 1.1)
        elif kind < 0.6:
            base, tall = span(rng, 1.0, 1.6), span(rng, 0.25, 0.9)
            fittings.framed(wall, (at, at + wide * 0.6), (base, min(base + tall, height - 0.1)), picture(rng), rng)
        elif kind < 0.68:
            fittings.disc(wall, at + 0.3, span(rng, 1.2, 2.0), span(rng, 0.1, 0.4), picture(rng))
        elif kind < 0.85:
            fittings.shelf(wall.moved(at, 0, 0), wide, span(rng, 0.7, min(2.2, height - 0.1)), rng)
        at += wide + span(rng, 0.1, 1.2)


def living(raster: Raster, rng: np.random.Generator) -> None:
    half, depth, height = span(rng, 1.4, 3.5), span(rng, 2.2, 7), span(rng, 2.3, 3.4)
    walls = _room(raster, rng, half, depth, height)
    for wall, length in zip(walls, (depth, 2 * half, depth), strict=True):
        _hung(wall, length, height, rng)
    pieces = (furniture.table, furniture.table, furniture.sofa, furniture.bed, furniture.chair)
    for _ in range(int(rng.integers(1, 5))):
        place = Site.facing(
            raster, (span(rng, -half, half) * 0.7, 0.0, span(rng, 1.2, depth)), math.pi + span(rng, -1.6, 1.6)
        )
        pieces[int(rng.integers(len(pieces)))](place, rng)
    if rng.random() < 0.5:
        potted_plant(
            Site.facing(raster, (span(rng, -half, half) * 0.9, 0.0, span(rng, 1.5, depth)), math.pi),
            span(rng, 0.5, 1.8),
            rng,
        )
    people(raster, (-half * 0.8, half * 0.8), (1.5, depth), int(rng.integers(0, 3)), rng)


def kitchen(raster: Raster, rng: np.random.Generator) -> None:
    half, depth, height = span(rng, 1.2, 2.4), span(rng, 2.0, 4.5), span(rng, 2.3, 2.9)
    walls = _room(raster, rng, half, depth, height)
    lined = rng.permutation(3)[: int(rng.integers(1, 4))]
    for n, (wall, length) in enumerate(zip(walls, (depth + 0.5, 2 * half, depth + 0.5), strict=True)):
        if n in lined:
            fittings.cabinets(wall, length, height, rng)
            if rng.random() < 0.5:
                s = span(rng, 0.3, max(0.4, length - 1.4))
                fittings.window(wall, (s, s + 1.0), (1.1, 2.0), rng)
        else:
            _hung(wall, length, height, rng)
    if rng.random() < 0.5:
        furniture.table(Site.facing(raster, (span(rng, -0.8, 0.8), 0.0, span(rng, 1.6, depth)), span(rng, 0, 6)), rng)
    people(raster, (-half * 0.8, half * 0.8), (1.2, depth), int(rng.integers(0, 2)), rng)


def aisle(raster: Raster, rng: np.random.Generator) -> None:
    """Between shelves: a shop, a library, a store."""
    half, depth, height = span(rng, 0.9, 2.2), span(rng, 4, 9), span(rng, 2.6, 5)
    walls = _room(raster, rng, half + 0.5, depth, height)
    tall = span(rng, 1.5, min(2.8, height))
    for wall, length in zip(walls, (depth, 2 * half, depth), strict=True):
        at = 0.0
        while at < length - 0.6:
            wide = span(rng, 0.8, 2)
            fittings.shelf(wall.moved(at, 0, 0.02), min(wide, length - at), tall, rng)
            at += wide + 0.02
    people(raster, (-half, half), (2, depth), int(rng.integers(0, 5)), rng)


def corridor(raster: Raster, rng: np.random.Generator) -> None:
    half, depth, height = span(rng, 0.8, 2.5), span(rng, 8, 25), span(rng, 2.3, 4)
    walls = _room(raster, rng, half, depth, height)
    for wall, length in zip(walls, (depth, 2 * half, depth), strict=True):
        _hung(wall, length, height, rng)
    pitch = span(rng, 1.2, 3)
    for z in np.arange(pitch, depth, pitch).tolist():
        place = Site.facing(raster, (0.0, 0.0, z), math.pi)
        place.box((-0.5, 0.5), (height - 0.04, height), (-0.15, 0.15), plain(1.4))
        if rng.random() < 0.3:
            for s in (-half, half - 0.25):
                place.box((s, s + 0.25), (0, height), (-0.15, 0.15), plain(span(rng, 0.2, 1)))
    people(raster, (-half * 0.8, half * 0.8), (2, depth), int(rng.integers(0, 5)), rng)
