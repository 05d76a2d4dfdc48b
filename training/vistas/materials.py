"""What things are made of: grey textures that repeat in metres, with smaller copies for the distance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from training.textures import draw_texture

Float32 = npt.NDArray[np.float32]
Level = tuple[Float32, Float32 | None]

SIDE_PX = 256
_LEVELS = 5


@dataclass(frozen=True)
class Material:
    """texture: float32 (rows, columns), roughly in [0, 1], seamless where it repeats. size_m: metres that it covers.
    cover: float32 of the same shape where above 0.5 there is something, or None."""

    texture: Float32
    size_m: float
    cover: Float32 | None = None

    @cached_property
    def mean(self) -> float:
        return float(self.texture.mean())

    @property
    def flat(self) -> bool:
        """Whether it is one tone."""
        return self.texture.size == 1

    @cached_property
    def _levels(self) -> list[Level]:
        levels: list[Level] = [(self.texture, self.cover)]
        for _ in range(_LEVELS - 1):
            texture, cover = levels[-1]
            size = (max(2, texture.shape[1] // 2), max(2, texture.shape[0] // 2))
            smaller = np.asarray(cv2.resize(texture, size, interpolation=cv2.INTER_AREA), np.float32)
            if cover is not None:
                cover = np.asarray(cv2.resize(cover, size, interpolation=cv2.INTER_AREA), np.float32)
            levels.append((smaller, cover))
        return levels

    def level(self, extent_px: float) -> Level:
        """Texture and cover for where the whole of it is `extent_px` wide in the picture."""
        wanted = np.log2(max(self.texture.shape[1] / max(extent_px, 1.0), 1.0))
        return self._levels[min(int(wanted), _LEVELS - 1)]


def span(rng: np.random.Generator, low: float, high: float) -> float:
    """A number between."""
    return float(rng.uniform(low, high))


def plain(tone: float) -> Material:
    """One tone."""
    return Material(np.full((1, 1), tone, np.float32), 1.0)


def noise(cells: int, rng: np.random.Generator, stretch: int = 1) -> Float32:
    """Seamless smooth noise in [0, 1], `cells` blots high and `cells` / `stretch` wide; float32 (SIDE_PX, SIDE_PX)."""
    blots = rng.random((cells, max(2, cells // stretch))).astype(np.float32)
    margin = 2
    wide = np.pad(blots, margin, mode="wrap")
    rows, columns = (SIDE_PX * n // k for n, k in zip(wide.shape, blots.shape, strict=True))
    smooth = cv2.resize(wide, (columns, rows), interpolation=cv2.INTER_CUBIC)
    top, left = margin * SIDE_PX // blots.shape[0], margin * SIDE_PX // blots.shape[1]
    return np.asarray(smooth[top : top + SIDE_PX, left : left + SIDE_PX].clip(0, 1), np.float32)


def plaster(rng: np.random.Generator) -> Material:
    """Walls and ceilings: nearly one tone, with stains and grain."""
    tone = float(rng.uniform(0.35, 0.95))
    texture = tone + (noise(5, rng) - 0.5) * rng.uniform(0.0, 0.12) + (noise(96, rng) - 0.5) * rng.uniform(0.0, 0.08)
    return Material(np.asarray(texture, np.float32), float(rng.uniform(1.5, 4)))


def wood(rng: np.random.Generator, planks: bool = True) -> Material:
    """Grain along the rows, and the joints of boards."""
    tone, contrast = float(rng.uniform(0.12, 0.75)), float(rng.uniform(0.05, 0.35))
    texture = tone + contrast * (noise(64, rng, 16) - 0.5) + 0.5 * contrast * (noise(16, rng, 8) - 0.5)
    if planks:
        boards = int(rng.integers(3, 9))
        for board in range(boards):
            top, bottom = board * SIDE_PX // boards, (board + 1) * SIDE_PX // boards
            texture[top:bottom] += rng.normal() * 0.06
            texture[top : top + 1] -= 0.2
            joint = int(rng.integers(0, SIDE_PX))
            texture[top:bottom, joint : joint + 1] -= 0.15
    return Material(np.asarray(texture, np.float32), float(rng.uniform(0.5, 1.4)))


def tiles(rng: np.random.Generator) -> Material:
    """Square or oblong tiles or bricks, each a little different, with joints."""
    rows = int(rng.integers(2, 13))
    columns = max(1, round(rows * float(rng.choice([1.0, 1.0, 0.5, 0.33]))))
    bond, joint = rng.random() < 0.5 and columns < rows, float(rng.uniform(-0.3, 0.3))
    tone, variety = float(rng.uniform(0.2, 0.85)), float(rng.uniform(0.0, 0.12))
    y, x = np.mgrid[0:SIDE_PX, 0:SIDE_PX]
    row = y * rows // SIDE_PX
    place = x * columns / SIDE_PX + (0.5 * (row % 2) if bond and rows % 2 == 0 else 0.0)
    column = np.floor(place).astype(int) % columns
    texture = tone + variety * rng.normal(size=(rows, columns))[row, column] + (noise(64, rng) - 0.5) * 0.1
    width = int(rng.integers(1, 4))
    at_joint = (y * rows % SIDE_PX < width * rows) | ((place % 1) * SIDE_PX < width * columns)
    texture = np.where(at_joint, tone + joint, texture)
    return Material(np.asarray(texture, np.float32), float(rng.uniform(0.5, 2.0)))


def boards(rng: np.random.Generator) -> Material:
    """Siding: long boards one above the other, each with its shadow."""
    count, tone = int(rng.integers(6, 16)), float(rng.uniform(0.3, 0.9))
    down = (np.arange(SIDE_PX) * count % SIDE_PX) / SIDE_PX
    texture = tone - 0.12 * down[:, None] - np.where(down < 0.12, rng.uniform(0.1, 0.35), 0)[:, None]
    return Material(np.asarray(texture + (noise(48, rng) - 0.5) * 0.05, np.float32), float(rng.uniform(1.2, 2.4)))


def ground(rng: np.random.Generator) -> Material:
    """Grass, gravel, asphalt, carpet, earth: grain of several sizes and no line."""
    tone, fine, coarse = float(rng.uniform(0.15, 0.7)), float(rng.uniform(0.1, 0.7)), float(rng.uniform(0.0, 0.3))
    texture = (
        tone + (noise(128, rng) - 0.5) * fine + (noise(40, rng) - 0.5) * fine * 0.6 + (noise(6, rng) - 0.5) * coarse
    )
    return Material(np.asarray(texture, np.float32), float(rng.uniform(0.6, 3.0)))


def cloth(rng: np.random.Generator) -> Material:
    """Blankets, carpets, curtains: a weave, a printed pattern, or bands, none of them quite straight."""
    y, x = np.mgrid[0:SIDE_PX, 0:SIDE_PX] / SIDE_PX * 2 * np.pi
    bent = (noise(4, rng) - 0.5) * rng.uniform(0.5, 3)
    a, b = rng.integers(1, 12, 2).tolist()
    pattern = np.sin(a * x + bent) * (np.cos(b * y - bent) if rng.random() < 0.6 else 1.0)
    if rng.random() < 0.4:
        pattern = np.sign(pattern)
    texture = rng.uniform(0.25, 0.8) + pattern * rng.uniform(0.02, 0.2) + (noise(100, rng) - 0.5) * 0.1
    return Material(np.asarray(texture, np.float32), float(rng.uniform(0.5, 1.8)))


def picture(rng: np.random.Generator) -> Material:
    """What hangs in a frame, stands on a cover, or runs on a screen."""
    if rng.random() < 0.5:
        return Material(draw_texture(rng), 1.0)
    cells = int(rng.integers(3, 14))
    texture = noise(cells, rng) * rng.uniform(0.3, 0.9) + noise(3 * cells, rng) * 0.25
    return Material(np.asarray(texture, np.float32), 1.0)


INDOOR: tuple[Callable[[np.random.Generator], Material], ...] = (plaster, plaster, plaster, wood, tiles, cloth)
FLOORS: tuple[Callable[[np.random.Generator], Material], ...] = (wood, tiles, ground, ground)
OUTDOOR: tuple[Callable[[np.random.Generator], Material], ...] = (plaster, tiles, tiles, boards)


def any_of(kinds: tuple[Callable[[np.random.Generator], Material], ...], rng: np.random.Generator) -> Material:
    """One of them."""
    return kinds[int(rng.integers(len(kinds)))](rng)
