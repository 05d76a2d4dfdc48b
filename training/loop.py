"""The training loop: endless at a constant rate, so that it can be stopped and taken up at any time; a cooldown, run
apart from a copy of the checkpoint, makes of it a network that ships.
"""

from __future__ import annotations

import copy
import json
import signal
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from training.checkpoints import Checkpoint
from training.labels import STRAIGHT, VALUES
from training.lineset_network import Layout, LinesetNetwork, NetworkShape
from training.losses import Truth, spread_loss, tempered
from training.random_distortions import KINDS
from training.sampler import Sampler, TrainingBatch
from training.second_look import second_look
from training.warm_start import inherit
from unbend_service.adapters.estimators.chain_features import FEATURES

SAVE_EVERY_S = 180.0
REPORT_EVERY_S = 30.0


@dataclass(frozen=True)
class Recipe:
    """How a run learns.

    nonlinear_weight: against 1 for the error of all: lenses first, pose second.
    second_look_every: so many batches are followed by a second look at one of them; 0 for never.
    """

    batch_size: int = 128
    learning_rate: float = 7.0e-4
    warmup_steps: int = 400
    weight_decay: float = 0.01
    average_decay: float = 0.999
    nonlinear_weight: float = 2.5
    gradient_limit: float = 20.0
    bfloat16: bool = True
    second_look_every: int = 2


def new_checkpoint(sampler: Sampler, shape: NetworkShape, seed: int, inherit_from: Path | None = None) -> Checkpoint:
    """Step zero: normalisation and output basis measured on samples, weights random or inherited."""
    torch.manual_seed(seed)
    generator = np.random.default_rng([seed, 1])
    network = LinesetNetwork(shape)
    batches = [sampler.draw(256, generator) for _ in range(8)]
    features = np.concatenate([batch.chains.features for batch in batches])
    network.feature_mean.copy_(torch.from_numpy(features.mean(0)))
    network.feature_scale.copy_(torch.from_numpy(features.std(0) + 1e-3))
    network.basis.copy_(_principal_basis(np.concatenate([batch.labels for batch in batches])))
    if inherit_from is not None:
        inherit(network, inherit_from)
    state = network.state_dict()
    return Checkpoint(
        shape=shape,
        model=state,
        average=copy.deepcopy(state),
        optimiser={},
        generator=dict(generator.bit_generator.state),
        step=0,
        samples=0,
        seconds=0.0,
        notes={"seed": seed, "inherited": inherit_from.name if inherit_from else None},
    )


def _principal_basis(labels: np.ndarray[Any, Any]) -> Tensor:
    """(72, 72): principal directions of the labels around the straight guides, scaled by their deviations."""
    offsets = (labels - STRAIGHT).clip(-1.2, 1.2)
    values, vectors = np.linalg.eigh(offsets.T @ offsets / len(offsets) + 1e-7 * np.eye(VALUES))
    return torch.tensor(vectors * np.sqrt(np.maximum(values, 0.008**2)), dtype=torch.float32)


@dataclass(frozen=True)
class Lesson:
    """What a step saw before it learned: node values (B, 72), errors of all and of the nonlinear part (B,), px, and
    the loss of the spreads."""

    values: Tensor
    overall: Tensor
    nonlinear: Tensor
    spread: float


class Run:
    """A training run in memory."""

    def __init__(self, checkpoint: Checkpoint, recipe: Recipe) -> None:
        self.recipe = recipe
        self.network = LinesetNetwork(checkpoint.shape)
        self.network.load_state_dict(checkpoint.model)
        self.average = LinesetNetwork(checkpoint.shape)
        self.average.load_state_dict(checkpoint.average)
        self.parameters = list(self.network.parameters())
        matrices = [p for p in self.parameters if p.ndim > 1]
        vectors = [p for p in self.parameters if p.ndim <= 1]
        self.optimiser = torch.optim.AdamW(
            [{"params": matrices, "weight_decay": recipe.weight_decay}, {"params": vectors, "weight_decay": 0.0}],
            lr=recipe.learning_rate,
            betas=(0.9, 0.99),
            fused=True,
        )
        if checkpoint.optimiser:
            self.optimiser.load_state_dict(checkpoint.optimiser)
        self.generator = checkpoint.restored_generator()
        self.step, self.samples = checkpoint.step, checkpoint.samples
        self.batches = int(checkpoint.notes.get("batches", 0))
        self.seconds, self.notes = checkpoint.seconds, dict(checkpoint.notes)
        self.inverse_basis = torch.linalg.inv(self.network.basis)
        self.warm_until = self.step + recipe.warmup_steps

    def checkpoint(self) -> Checkpoint:
        return Checkpoint(
            shape=self.network.shape,
            model=self.network.state_dict(),
            average=self.average.state_dict(),
            optimiser=self.optimiser.state_dict(),
            generator=dict(self.generator.bit_generator.state),
            step=self.step,
            samples=self.samples,
            seconds=self.seconds,
            notes={**self.notes, "batches": self.batches},
        )

    def learn(self, batch: TrainingBatch, rate_scale: float = 1.0) -> Lesson:
        """One step."""
        warm = min(1.0, 0.02 + 1 - (self.warm_until - self.step) / max(self.recipe.warmup_steps, 1))
        for group in self.optimiser.param_groups:
            group["lr"] = self.recipe.learning_rate * rate_scale * warm
        source, target, weight, slopes, labels = (
            torch.from_numpy(a) for a in (batch.source, batch.target, batch.weight, batch.slopes, batch.labels)
        )
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=self.recipe.bfloat16):
            estimates, spreads = self.network.estimates(*packed_input(batch))
        truth = Truth(source, target, weight, slopes)
        guide_loss = torch.zeros(())
        for values in estimates:
            overall, nonlinear = truth.errors(values)
            guide_loss = guide_loss + (tempered(overall) + self.recipe.nonlinear_weight * tempered(nonlinear)).mean()
        spread = spread_loss(spreads, values, labels, self.inverse_basis, overall, nonlinear)
        self.optimiser.zero_grad(set_to_none=True)
        torch.autograd.backward(guide_loss + spread)
        torch.nn.utils.clip_grad_norm_(self.parameters, self.recipe.gradient_limit)
        self.optimiser.step()
        self.step += 1
        decay = min(self.recipe.average_decay, (1 + self.step) / (20 + self.step))
        with torch.no_grad():
            torch._foreach_lerp_(list(self.average.parameters()), self.parameters, 1 - decay)
        return Lesson(values.detach(), overall.detach(), nonlinear.detach(), float(spread.detach()))

    def learn_again(self, batch: TrainingBatch, values: Tensor, rate_scale: float = 1.0) -> Lesson:
        """A step on the second look at a batch whose first look gave `values`."""
        return self.learn(second_look(batch, values, self.network.straightening), rate_scale)


def packed_input(batch: TrainingBatch) -> tuple[Tensor, Layout]:
    """Arguments of `LinesetNetwork.estimates`."""
    chains = batch.chains
    slots = int(chains.slot.max(initial=0)) + 1
    mask = np.zeros((chains.batch_size, slots), np.float32)
    mask[chains.picture, chains.slot] = 1
    place = torch.from_numpy(chains.picture * slots + chains.slot)
    return torch.from_numpy(chains.features), Layout(torch.from_numpy(mask), place, torch.from_numpy(chains.picture))


class Progress:
    """Errors by kind since the last report, written as one JSON line to the log and to standard output."""

    def __init__(self, log: Path) -> None:
        self._log = log
        self._overall: dict[int, list[float]] = defaultdict(list)
        self._nonlinear: dict[int, list[float]] = defaultdict(list)
        self._looks: list[tuple[float, float]] = []
        self.last = time.monotonic()

    def note(self, batch: TrainingBatch, lesson: Lesson, again: Lesson | None) -> None:
        if again is not None:
            self._looks.append((float(lesson.nonlinear.mean()), float(again.nonlinear.mean())))
        for kind, a, b in zip(batch.kind.tolist(), lesson.overall.tolist(), lesson.nonlinear.tolist(), strict=True):
            self._overall[kind].append(a)
            self._nonlinear[kind].append(b)

    def report(self, run: Run, **more: float) -> None:
        everything = [e for errors_ in self._overall.values() for e in errors_]
        bent = [e for errors_ in self._nonlinear.values() for e in errors_]
        line = {
            "minutes": round(run.seconds / 60, 2),
            "step": run.step,
            "samples": run.samples,
            "epe": round(float(np.mean(everything)), 3),
            "nonlinear": round(float(np.mean(bent)), 4),
            "nonlinear_median": round(float(np.median(bent)), 4),
            "looks": [round(float(a), 4) for a in np.mean(self._looks, 0)] if self._looks else [],
            **{name: round(value, 5) for name, value in more.items()},
            "by_kind": {
                KINDS[k]: [round(float(np.mean(self._overall[k])), 2), round(float(np.mean(v)), 3)]
                for k, v in sorted(self._nonlinear.items())
            },
        }
        with open(self._log, "a") as file:
            file.write(json.dumps(line) + "\n")
        print(json.dumps(line), flush=True)
        self._overall.clear()
        self._nonlinear.clear()
        self._looks.clear()
        self.last = time.monotonic()


class _Stop:
    """Set by SIGTERM and SIGINT: finish the step, save, leave."""

    def __init__(self) -> None:
        self.asked = False

    def __call__(self, _signal: int, _frame: object) -> None:
        self.asked = True


def train(
    run: Run,
    sampler: Sampler,
    directory: Path,
    *,
    name: str = "run",
    minutes: float | None = None,
    steps: int | None = None,
    cooling: bool = False,
) -> None:
    """Learns for so many more minutes or steps (or until told to stop), saving to `directory`/`name`.pt.

    With `cooling`, the rate falls linearly to zero over that span.
    """
    stop = _Stop()
    previous = {s: signal.signal(s, stop) for s in (signal.SIGTERM, signal.SIGINT)}
    path = directory / f"{name}.pt"
    progress = Progress(directory / f"{name}.jsonl")
    began, saved, drawing_s, first_batch = time.monotonic(), time.monotonic(), 0.0, run.batches
    before, reported_samples = run.seconds, run.samples
    while not stop.asked:
        elapsed = time.monotonic() - began
        done = max(elapsed / 60 / minutes if minutes else 0.0, (run.batches - first_batch) / steps if steps else 0.0)
        if done >= 1:
            break
        start = time.monotonic()
        batch = sampler.draw(run.recipe.batch_size, run.generator)
        drawing_s += time.monotonic() - start
        rate = max(1 - done, 0.0) if cooling else 1.0
        lesson, again = run.learn(batch, rate), None
        run.samples += len(batch.kind)
        run.batches += 1
        if run.recipe.second_look_every and run.batches % run.recipe.second_look_every == 0:
            again = run.learn_again(batch, lesson.values, rate)
        run.seconds = before + time.monotonic() - began
        progress.note(batch, lesson, again)
        if time.monotonic() - progress.last > REPORT_EVERY_S:
            interval = time.monotonic() - progress.last
            progress.report(
                run,
                spread=lesson.spread,
                drawing=drawing_s / (time.monotonic() - began),
                samples_per_s=(run.samples - reported_samples) / interval,
            )
            reported_samples = run.samples
        if time.monotonic() - saved > SAVE_EVERY_S:
            run.checkpoint().save(path)
            saved = time.monotonic()
    run.checkpoint().save(path)
    for number, handler in previous.items():
        signal.signal(number, handler)


def default_shape() -> NetworkShape:
    return NetworkShape(features=FEATURES)
