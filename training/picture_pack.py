"""The training pictures in one file, in the order in which the chain store has them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from training.chain_store import DRAWN, Picture

Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class PicturePack:
    """pictures: grey uint8, of any size. sources: of each, as in the chain store."""

    pictures: list[Bytes]
    sources: npt.NDArray[np.str_]

    @staticmethod
    def of(pictures: Sequence[Picture]) -> PicturePack:
        return PicturePack([grey for _, grey in pictures], np.array([source for source, _ in pictures]))

    def save(self, path: Path) -> None:
        """Written whole or not at all."""
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_suffix(".tmp.npz")
        np.savez(
            temporary,
            flat=np.concatenate([p.ravel() for p in self.pictures]),
            sizes=np.array([p.shape for p in self.pictures], np.int64),
            sources=self.sources,
        )
        os.replace(temporary, path)

    @staticmethod
    def load(path: Path) -> PicturePack:
        with np.load(path) as file:
            flat, sizes, sources = file["flat"], file["sizes"], file["sources"]
        ends = np.cumsum(sizes.prod(1))[:-1]
        pictures = [part.reshape(size) for part, size in zip(np.split(flat, ends), sizes.tolist(), strict=True)]
        return PicturePack(pictures, sources)

    def only(self, sources: tuple[str, ...] | None, drawn_share: float) -> list[Bytes]:
        """The photographs of these sources, or all, and so many drawn scenes that they are `drawn_share` of the list,
        if there are as many."""
        drawn = [p for p, source in zip(self.pictures, self.sources.tolist(), strict=True) if source == DRAWN]
        taken = [
            p
            for p, source in zip(self.pictures, self.sources.tolist(), strict=True)
            if source != DRAWN and (sources is None or source in sources)
        ]
        return taken + drawn[: round(len(taken) * drawn_share / (1 - drawn_share)) if taken else None]
