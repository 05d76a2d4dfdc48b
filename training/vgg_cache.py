"""What the frozen trunk makes of the training pictures, computed once and kept: shards of float16 activations."""

from __future__ import annotations

import os
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from training.vgg_data import Sample
from training.vgg_network import Head, Trunk

SHARD_SAMPLES = 500
_BATCH = 10


@dataclass(frozen=True)
class Shard:
    """activations: float16 (n, 512, 14, 14), mapped, not read. coefficients: float32 (n, 16), not rescaled."""

    activations: npt.NDArray[np.float16]
    coefficients: npt.NDArray[np.float32]


def shard_path(folder: Path, name: str) -> Path:
    return folder / f"{name}.activations.npy"


def write_shard(trunk: Trunk, samples: Iterator[Sample], folder: Path, name: str) -> None:
    """Runs the trunk (bfloat16, which is what processors with matrix units are fast at) and keeps what it says; the
    activations are put in place last, so that a shard is there whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    activations, coefficients = [], []
    trunk = trunk.to(torch.bfloat16).to(memory_format=torch.channels_last).eval()
    with torch.no_grad():
        while batch := list(islice(samples, _BATCH)):
            grey = torch.tensor(np.stack([picture for picture, _ in batch])[:, None], dtype=torch.bfloat16)
            answer = trunk(grey.to(memory_format=torch.channels_last))
            activations.append(answer.float().contiguous().clamp(max=6e4).numpy().astype(np.float16))
            coefficients += [labels for _, labels in batch]
    np.save(folder / f"{name}.coefficients.npy", np.array(coefficients, np.float32))
    temporary = folder / f"{name}.tmp.npy"
    np.save(temporary, np.concatenate(activations))
    os.replace(temporary, shard_path(folder, name))


def read_shards(folder: Path, prefix: str) -> list[Shard]:
    """All shards of a prefix (train, val) that are complete by now, in order."""
    shards = []
    for path in sorted(folder.glob(f"{prefix}-*.activations.npy")):
        labels = path.with_name(path.name.replace(".activations.", ".coefficients."))
        shards.append(Shard(np.load(path, mmap_mode="r"), np.load(labels)))
    return shards


def pooled_features(head: Head, folder: Path, prefix: str) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """What the convolutions of an untrained head make of all shards of a prefix: float32 (n, 25088), and the
    coefficients (n, 16). Kept beside the shards, as float16, so that it is computed once."""
    convolutions = deepcopy(head.layers).to(torch.bfloat16).to(memory_format=torch.channels_last).eval()
    features, labels = [], []
    for path, shard in zip(
        sorted(folder.glob(f"{prefix}-*.activations.npy")), read_shards(folder, prefix), strict=True
    ):
        kept = path.with_name(path.name.replace(".activations.", ".pooled."))
        if not kept.exists():
            parts = []
            with torch.no_grad():
                for start in range(0, len(shard.coefficients), _BATCH):
                    read = torch.tensor(np.asarray(shard.activations[start : start + _BATCH], np.float32))
                    seen = convolutions(read.to(torch.bfloat16).contiguous(memory_format=torch.channels_last))
                    parts.append(seen.float().flatten(1).numpy().astype(np.float16))
            temporary = folder / "pooled.tmp.npy"
            np.save(temporary, np.concatenate(parts))
            os.replace(temporary, kept)
        features.append(np.load(kept).astype(np.float32))
        labels.append(shard.coefficients)
    return np.concatenate(features), np.concatenate(labels)
