"""Places where things stand: a corner, two directions along the ground, and up."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from training.vistas.materials import Material
from training.vistas.raster import Raster

Float64 = npt.NDArray[np.float64]
Point = tuple[float, float, float]

_UP = np.array([0.0, 1.0, 0.0])
#: Of the corners of a box, counted by s, then t, then out: front, back, left, right, top, bottom, each clockwise.
_SIDES = ([6, 7, 5, 4], [3, 2, 0, 1], [2, 6, 4, 0], [7, 3, 1, 5], [2, 3, 7, 6], [4, 5, 1, 0])


@dataclass(frozen=True)
class Site:
    """Local coordinates (s, t, out) in metres: s to the right as seen from where `out` points to, t up, out forward,
    so that a wall is the plane out = 0 and what stands before it has out > 0."""

    raster: Raster
    origin: Float64
    along: Float64
    out: Float64

    @staticmethod
    def facing(raster: Raster, origin: Point, bearing: float) -> Site:
        """Its `out` points to `bearing`, in radians to the right of the world's +z."""
        out = np.array([np.sin(bearing), 0.0, np.cos(bearing)])
        return Site(raster, np.array(origin, float), np.cross(out, _UP), out)

    @cached_property
    def _axes(self) -> Float64:
        return np.stack([self.along, _UP, self.out])

    def world(self, points: npt.ArrayLike) -> Float64:
        """(n, 3) local -> world."""
        return np.asarray(np.asarray(points, float) @ self._axes + self.origin)

    def _seen(self, points: npt.ArrayLike) -> Float64:
        return self.raster.camera.seen(self.world(points))

    def moved(self, s: float, t: float, out: float, turn: float = 0.0) -> Site:
        """A site in this one, turned by `turn` radians about the vertical."""
        c, n = np.cos(turn), np.sin(turn)
        origin = self.world([(s, t, out)])[0]
        return Site(self.raster, origin, self.along * c - self.out * n, self.along * n + self.out * c)

    def face(self, corners: list[Point], material: Material, tone: float = 1.0, *, stretched: bool = False) -> None:
        """A flat polygon seen from both sides, from its upper left corner to the right."""
        self.raster.polygon(self._seen(corners), material, tone, stretched=stretched)

    def panel(
        self, s: tuple[float, float], t: tuple[float, float], out: float, material: Material, tone: float = 1.0
    ) -> None:
        """An upright rectangle parallel to the wall, covered once by the material."""
        corners = [(s[0], t[1], out), (s[1], t[1], out), (s[1], t[0], out), (s[0], t[0], out)]
        self.raster.polygon(self._seen(corners), material, tone, stretched=True, one_sided=True)

    def box(
        self,
        s: tuple[float, float],
        t: tuple[float, float],
        out: tuple[float, float],
        material: Material,
        tone: float = 1.0,
    ) -> None:
        """A block; its sides are seen from outside only."""
        corners = self._seen([(a, b, c) for c in out for b in t for a in s])
        if not self.raster.misses(corners):
            for side in _SIDES:
                self.raster.polygon(corners[side], material, tone, one_sided=True)

    def round(
        self,
        s: float,
        out: float,
        profile: list[tuple[float, float]],
        material: Material,
        tone: float = 1.0,
        sides: int = 20,
    ) -> None:
        """What a lathe makes: profile of (radius, t), from below upwards; closed above."""
        angles = np.linspace(0, 2 * np.pi, sides, endpoint=False)
        rings = [
            self._seen(np.stack([s + r * np.cos(angles), np.full(sides, t), out + r * np.sin(angles)], 1))
            for r, t in profile
        ]
        if self.raster.misses(np.concatenate(rings)):
            return
        for lower, upper in itertools.pairwise(rings):
            for a, b in zip(range(sides), [*range(1, sides), 0], strict=True):
                corners = np.stack([upper[b], upper[a], lower[a], lower[b]])
                self.raster.polygon(corners, material, tone, one_sided=True)
        self.raster.polygon(rings[-1][::-1], material, tone)
