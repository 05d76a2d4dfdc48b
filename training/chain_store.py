"""The chain store: edge chains of every training picture at several scales, extracted once.

Training warps these points, never images. One .npz holds everything: points as int16 fractions of the isotropic unit
(1/32767, or 0.008 px of a 512 px picture), strengths as float16, and offsets.
"""

from __future__ import annotations

import csv
import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from multiprocessing.pool import Pool
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from training.scenes import draw_scene
from unbend_service.adapters.estimators.chains import EdgeChains, extract

Float32 = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int64]
Picture = tuple[str, npt.NDArray[np.uint8]]
DrawScene = Callable[[np.random.Generator], npt.NDArray[np.uint8]]

LEVELS = (1.3333, 1.0, 0.75, 0.55, 0.4)
"""Scales at which each picture is searched; the first stands for pictures that were enlarged, as small crops are."""
QUANTUM = 32767.0
SHORTEST_SIDE_PX = 200
LONGEST_SIDE_PX = 1000
DRAWN = "drawn"
FREE_SOURCES = (
    "facades_spb", "gcompris", "gcompris_more", "kphotoalbum_demo", "libjxl_testdata", "lomiri_wallpapers",
    "lxqt_themes", "palapeli", "plasma_wallpapers", "scikit_image", "scikit_learn", "scratch", "tuxpaint_templates",
)  # fmt: skip
"""Photographs under CC0 or the free licences of Debian packages; each licence is in its folder's SOURCES.md."""


@dataclass(frozen=True)
class ChainStore:
    """Chains of `pictures` x len(LEVELS).

    x, y: int16 (n,), isotropic frame times QUANTUM. strength: float16 (n,). starts: bool (n,).
    offsets: int64 (pictures * levels + 1,), picture-major. size_px: float64 (pictures, 2), width and height at scale 1.
    source: str (pictures,), the folder a photograph came from, or DRAWN.
    """

    x: npt.NDArray[np.int16]
    y: npt.NDArray[np.int16]
    strength: npt.NDArray[np.float16]
    starts: npt.NDArray[np.bool_]
    offsets: Ints
    size_px: npt.NDArray[np.float64]
    source: npt.NDArray[np.str_]

    @property
    def pictures(self) -> int:
        return len(self.size_px)

    def save(self, path: Path) -> None:
        """Written whole or not at all."""
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_suffix(".tmp.npz")
        np.savez(temporary, **vars(self))
        os.replace(temporary, path)

    @staticmethod
    def load(path: Path) -> ChainStore:
        with np.load(path) as file:
            return ChainStore(**{name: file[name] for name in file.files})


def training_photographs(
    folder: Path, sources: tuple[str, ...] | None = None, split: str = "train"
) -> Iterator[Picture]:
    """(source, grey uint8 picture) of every photograph of that split in the folder's index.csv, of the named sources
    or of all."""
    with open(folder / "index.csv", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["split"] == split]
    for row in rows:
        if sources is not None and row["source"] not in sources:
            continue
        grey = cv2.imread(str(folder / row["path"]), cv2.IMREAD_GRAYSCALE)
        if grey is not None and min(grey.shape) >= SHORTEST_SIDE_PX:
            yield row["source"], np.asarray(grey, np.uint8)


def drawn_scenes(count: int, seed: int, processes: int = 1, draw: DrawScene = draw_scene) -> Iterator[Picture]:
    """(DRAWN, grey uint8 picture) of `count` scenes, drawn by `scenes.draw_scene` or by `vistas.draw_scene`."""
    numbers = [(draw, seed, index) for index in range(count)]
    if processes == 1:
        yield from map(_drawn, numbers)
        return
    with _forked(processes) as pool:
        yield from pool.imap(_drawn, numbers, chunksize=4)


def _forked(processes: int) -> Pool:
    cv2.setNumThreads(1)  # a fork waits for OpenCV's threads for ever
    return multiprocessing.get_context("fork").Pool(processes)


def _drawn(number: tuple[DrawScene, int, int]) -> Picture:
    draw, *seed = number
    return DRAWN, draw(np.random.default_rng(seed))


def build_store(pictures: Iterable[Picture], processes: int = 1) -> ChainStore:
    """Extracts the chains of all pictures at all levels."""
    if processes == 1:
        return _stored(map(_searched, pictures))
    with _forked(processes) as pool:
        return _stored(pool.imap(_searched, pictures, chunksize=4))


def _searched(picture: Picture) -> tuple[str, tuple[int, int], list[EdgeChains]]:
    """The source and size of a picture, and its chains at each level."""
    source, grey = picture
    shrink = min(1.0, LONGEST_SIDE_PX / max(grey.shape))
    height, width = (round(side * shrink) for side in grey.shape)
    extracted = []
    for level in LEVELS:
        size = (max(16, round(width * level)), max(16, round(height * level)))
        enlarging = size[0] > grey.shape[1]
        scaled = cv2.resize(grey, size, interpolation=cv2.INTER_LINEAR if enlarging else cv2.INTER_AREA)
        extracted.append(extract(np.asarray(scaled, np.uint8)))
    return source, (width, height), extracted


def _stored(searched: Iterable[tuple[str, tuple[int, int], list[EdgeChains]]]) -> ChainStore:
    extracted: list[EdgeChains] = []
    sizes: list[tuple[int, int]] = []
    sources: list[str] = []
    for source, size, chains in searched:
        extracted += chains
        sizes.append(size)
        sources.append(source)
    lengths = [len(chains.x) for chains in extracted]

    return ChainStore(
        x=np.concatenate([np.round(c.x * QUANTUM) for c in extracted]).astype(np.int16),
        y=np.concatenate([np.round(c.y * QUANTUM) for c in extracted]).astype(np.int16),
        strength=np.concatenate([np.minimum(c.strength, 6e4) for c in extracted]).astype(np.float16),
        starts=np.concatenate([c.starts for c in extracted]),
        offsets=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        size_px=np.array(sizes, np.float64),
        source=np.array(sources),
    )
