"""Processes that draw training batches, so that a GPU never waits for one.

Each process draws batch after batch, keeps the last ones, and is told which of them the networks want to look at a
second time, and what they said at the first. Batches arrive in whatever order they are ready.
"""

from __future__ import annotations

import queue
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
import torch.multiprocessing
from torch import Tensor

from training.picture_sampler import PictureSampler
from training.sampler import Sampler, TrainingBatch
from training.second_look import second_look
from training.straightening import Straightening

_READY_EACH = 3
_KEPT = 24
"""Batches that a process keeps for second looks: those in the queue, and those being learned."""

Draw = Callable[[np.random.Generator], tuple[TrainingBatch, dict[str, Tensor]]]


@dataclass(frozen=True)
class Drawn:
    """A batch as tensors: the fields of `batch_tensors`, and what `Draw` adds to see the pictures (nothing for second
    looks). process, number: who drew it; again: whether it is a second look."""

    tensors: dict[str, Tensor]
    process: int
    number: int
    again: bool

    def to(self, device: torch.device) -> dict[str, Tensor]:
        return {name: tensor.to(device, non_blocking=True) for name, tensor in self.tensors.items()}


def imitated(sampler: Sampler, size: int) -> Draw:
    """Chains warped, pictures to be seen through an `atlas`."""

    def draw(generator: np.random.Generator) -> tuple[TrainingBatch, dict[str, Tensor]]:
        batch, specs = sampler.draw_with_views(size, generator)
        return batch, {f"view_{name}": torch.from_numpy(array) for name, array in vars(specs).items()}

    return draw


def extracted(sampler: PictureSampler, size: int) -> Draw:
    """Pictures warped, chains extracted from them as the service does."""

    def draw(generator: np.random.Generator) -> tuple[TrainingBatch, dict[str, Tensor]]:
        drawn = sampler.draw(size, generator)
        return drawn.batch, {"views": torch.from_numpy(drawn.views)}

    return draw


def batch_tensors(batch: TrainingBatch) -> dict[str, Tensor]:
    """features (m, F), picture (m,), slot (m,); extent (B, 2); source, target, weight, slopes, labels, kind."""
    arrays = {
        "features": batch.chains.features,
        "picture": batch.chains.picture,
        "slot": batch.chains.slot,
        "extent": batch.points.half_extent,
        "source": batch.source,
        "target": batch.target,
        "weight": batch.weight,
        "slopes": batch.slopes,
        "labels": batch.labels,
        "kind": batch.kind,
    }
    return {name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in arrays.items()}


class Drawing:
    """`draws`: what each process draws; process i draws its batch n from the generator seeded with (seed, i, n)."""

    def __init__(self, draws: list[Draw], seed: int) -> None:
        torch.multiprocessing.set_sharing_strategy("file_system")
        # Forked, so that all share one copy of the store; before the first use of a GPU, which no fork survives, and
        # without OpenCV's threads, for which a fork would wait for ever.
        cv2.setNumThreads(1)
        context = torch.multiprocessing.get_context("fork")
        self._ready: Any = context.Queue(_READY_EACH * len(draws))
        self._asked: list[Any] = [context.Queue() for _ in draws]
        self._processes = [
            context.Process(target=_draw, args=(draw, (seed, i), self._ready, self._asked[i]), daemon=True)
            for i, draw in enumerate(draws)
        ]
        for process in self._processes:
            process.start()

    def __iter__(self) -> Iterator[Drawn]:
        """Endless."""
        while True:
            try:
                yield self._ready.get(timeout=60)
            except queue.Empty:
                if not all(process.is_alive() for process in self._processes):
                    raise RuntimeError("A process that draws batches died.") from None

    def look_again(self, drawn: Drawn, values: Tensor) -> None:
        """Asks for the second look at a batch whose first look gave node values (B, 72)."""
        self._asked[drawn.process].put((drawn.number, values.detach().float().cpu().numpy()))

    def stop(self) -> None:
        for process in self._processes:
            process.kill()
        for asked in self._asked:
            asked.cancel_join_thread()  # nobody will read what is still being written
        for process in self._processes:
            process.join()


def _draw(draw: Draw, seed: tuple[int, int], ready: Any, asked: Any) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    straightening = Straightening()
    kept: dict[int, TrainingBatch] = {}
    number = 0
    while True:
        for wanted, values in _waiting(asked):
            if wanted in kept:
                again = second_look(kept.pop(wanted), torch.from_numpy(values), straightening)
                ready.put(Drawn(batch_tensors(again), seed[1], wanted, again=True))
        batch, seen = draw(np.random.default_rng([*seed, number]))
        kept[number] = batch
        if len(kept) > _KEPT:
            del kept[min(kept)]
        ready.put(Drawn({**batch_tensors(batch), **seen}, seed[1], number, again=False))
        number += 1


def _waiting(asked: Any) -> Iterator[Any]:
    while True:
        try:
            yield asked.get_nowait()
        except queue.Empty:
            return
