"""Training the head of the paper's network on cached activations: resumable, seeded, with a line of progress.

The loss is the paper's: the mean squared error of the sixteen coefficients, rescaled to 0..1. (Two numbers are logged
with it: the same on pictures of held-out photographs, and what the mean of all targets would cost there.)
"""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from training.vgg_cache import Shard, pooled_features, read_shards
from training.vgg_network import Head, RescaledGuides
from training.vgg_regression import regress

_BATCH = 32
_SAVED_EVERY_S = 120.0
_RANGE_MARGIN = 0.02


@dataclass(frozen=True)
class Recipe:
    """How the head is trained. minutes: of the process, until the rate has fallen to zero along a cosine."""

    minutes: float
    seed: int = 7
    convolution_rate: float = 1e-5
    node_rate: float = 1e-6  # each node sums 25,088 activations, and a step of Adam moves all its weights
    weight_decay: float = 0.02


class HeadRun:
    """A run at one moment: head, optimiser, randomness, and the ranges of the coefficients."""

    def __init__(self, head: Head, rescaling: RescaledGuides, recipe: Recipe) -> None:
        self.head = head.to(memory_format=torch.channels_last)
        self.rescaling = rescaling
        self.recipe = recipe
        self.optimiser = torch.optim.AdamW(
            [
                {"params": head.layers.parameters(), "lr": recipe.convolution_rate},
                {"params": [*head.nodes.parameters(), *head.normalisation.parameters()], "lr": recipe.node_rate},
            ],
            weight_decay=recipe.weight_decay,
            betas=(0.9, 0.99),
        )
        self.rng = np.random.default_rng(recipe.seed)
        self.step = self.samples = 0
        self.seconds = 0.0

    def state(self) -> dict[str, Any]:
        return {
            "head": self.head.state_dict(),
            "rescaling": self.rescaling.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "generator": self.rng.bit_generator.state,
            "torch_generator": torch.get_rng_state(),
            "step": self.step,
            "samples": self.samples,
            "seconds": self.seconds,
        }

    def restore(self, state: dict[str, Any]) -> None:
        self.head.load_state_dict(state["head"])
        self.rescaling.load_state_dict(state["rescaling"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.rng.bit_generator.state = state["generator"]
        torch.set_rng_state(state["torch_generator"])
        self.step, self.samples, self.seconds = state["step"], state["samples"], state["seconds"]

    def save(self, path: Path) -> None:
        """Written whole or not at all."""
        temporary = path.with_suffix(".tmp")
        torch.save(self.state(), temporary)
        os.replace(temporary, path)

    def rate(self) -> float:
        """Share of the full learning rate: a short rise, then half a cosine over the minutes of the recipe."""
        progress = min(self.seconds / (60 * self.recipe.minutes), 1.0)
        return min(1.0, (self.step + 1) / 50) * (0.5 + 0.5 * float(np.cos(np.pi * progress)))

    def train_on(self, activations: Tensor, coefficients: Tensor) -> float:
        """One step; the loss before it."""
        self.head.train()
        self.head.normalisation.eval()  # its statistics are those of all training pictures, not of a batch
        for group, full in zip(
            self.optimiser.param_groups, (self.recipe.convolution_rate, self.recipe.node_rate), strict=True
        ):
            group["lr"] = full * self.rate()
        with torch.autocast("cpu", torch.bfloat16):
            rescaled = self.head(activations)
        loss = nn.functional.mse_loss(rescaled.float(), self.rescaling.rescaled(coefficients))
        self.optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.head.parameters(), 1.0)
        self.optimiser.step()
        self.step += 1
        self.samples += len(activations)
        return float(loss.item())

    def held_out(self, shard: Shard, limit: int = 200) -> tuple[float, float]:
        """Loss on pictures of held-out photographs, and that of answering with the mean."""
        self.head.eval()
        every = np.arange(min(limit, len(shard.coefficients)))
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
            parts = np.array_split(every, max(1, len(every) // _BATCH))
            answered = torch.cat([self.head(_activations(shard, part)).float() for part in parts])
        wanted = self.rescaling.rescaled(torch.tensor(shard.coefficients[: len(answered)]))
        constant = wanted.mean(0, keepdim=True)
        return float(((answered - wanted) ** 2).mean()), float(((constant - wanted) ** 2).mean())


def new_run(head: Head, folder: Path, recipe: Recipe) -> HeadRun:
    """Ranges from the labels of all training pictures, and nodes that begin as a regression on them."""
    features, labels = pooled_features(head, folder, "train")
    low, high = labels.min(0).astype(np.float64), labels.max(0).astype(np.float64)
    margin = _RANGE_MARGIN * (high - low)
    rescaling = RescaledGuides(low - margin, high + margin)
    wanted = rescaling.rescaled(torch.tensor(labels)).numpy().astype(np.float64)
    start = regress(features, wanted)
    print(f"start: ridge {start.ridge:g} of {start.errors}, mean answer {start.constant_error:.5f}", flush=True)
    answers = torch.tensor(features @ start.weight.T + start.bias)
    head.start_from(torch.tensor(start.weight), torch.tensor(start.bias), answers.std(0), answers.mean(0))
    torch.manual_seed(recipe.seed)
    return HeadRun(head, rescaling, recipe)


def train(run: HeadRun, folder: Path, checkpoint: Path) -> None:
    """Until the minutes are over, or SIGTERM or Ctrl-C. Shards that appear meanwhile are used from then on."""
    stopped: list[int] = []
    before = [(name, signal.signal(name, lambda *_: stopped.append(1))) for name in (signal.SIGTERM, signal.SIGINT)]
    log = checkpoint.with_suffix(".jsonl")
    validation = read_shards(folder, "val")[0]
    if not run.step:
        run.save(checkpoint)
        _note(run, validation, float("nan"), log)
    began, saved, losses = time.monotonic() - run.seconds, time.monotonic(), []
    if run.recipe.minutes <= 0:
        return
    try:
        for activations, coefficients in _batches(folder, run.rng):
            losses.append(run.train_on(activations, coefficients))
            run.seconds = time.monotonic() - began
            over = bool(stopped) or run.seconds > 60 * run.recipe.minutes
            if over or time.monotonic() - saved > _SAVED_EVERY_S:
                run.save(checkpoint)
                _note(run, validation, float(np.mean(losses)), log)
                saved, losses = time.monotonic(), []
            if over:
                return
    finally:
        for name, handler in before:
            signal.signal(name, handler)


def _note(run: HeadRun, validation: Shard, loss: float, log: Path) -> None:
    held_out, constant = run.held_out(validation)
    line = {
        "step": run.step,
        "samples": run.samples,
        "minutes": round(run.seconds / 60, 1),
        "loss": loss,
        "held_out": held_out,
        "held_out_mean_answer": constant,
    }
    with open(log, "a") as file:
        file.write(json.dumps(line) + "\n")
    print(" ".join(f"{name} {value:.5g}" for name, value in line.items()), flush=True)


def _batches(folder: Path, rng: np.random.Generator) -> Iterator[tuple[Tensor, Tensor]]:
    """Shuffled over all shards, epoch after epoch."""
    while True:
        shards = read_shards(folder, "train")
        pairs = np.array([(s, i) for s, shard in enumerate(shards) for i in range(len(shard.coefficients))])
        order = rng.permutation(len(pairs))
        for start in range(0, len(order) - _BATCH + 1, _BATCH):
            chosen = pairs[order[start : start + _BATCH]]
            activations = torch.cat([_activations(shards[s], np.array([i])) for s, i in chosen])
            labels = np.stack([shards[s].coefficients[i] for s, i in chosen])
            yield activations, torch.tensor(labels)


def _activations(shard: Shard, index: npt.NDArray[np.intp]) -> Tensor:
    read = torch.tensor(np.asarray(shard.activations[index], np.float32))
    return read.contiguous(memory_format=torch.channels_last)
