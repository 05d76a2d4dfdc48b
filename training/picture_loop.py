"""Training of the picture branch beside a line-set network that stays as it is.

Batch i is drawn by a generator seeded with (seed, i), whichever process draws it, so that a run that was stopped goes
on with the batches it would have had.
"""

# mypy: disallow-subclassing-any=False, disallow-untyped-decorators=False
# (types are also checked where torch is not installed, and its modules are Any)
from __future__ import annotations

import copy
import json
import os
import signal
import time
from collections import defaultdict, deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from training.lineset_network import LinesetNetwork
from training.loop import packed_input
from training.losses import Truth, tempered
from training.picture_network import BranchShape, PictureBranch
from training.picture_sampler import PictureBatch, PictureSampler
from training.random_distortions import KINDS
from training.sampler import TrainingBatch

SAVE_EVERY_S = 180.0
REPORT_EVERY_S = 30.0
_REPORTED = ("nonlinear_before", "nonlinear", "all_before", "all")


@dataclass(frozen=True)
class BranchRecipe:
    """How the branch learns. nonlinear_weight: against 1 for the error of all. own_weight: of the error of the
    branch's own guides, against 1 for the fused ones. trunk_share: of the rate, for the layers that begin with what the
    first network knew. remembered: batches of which one is learned again after every new one, as drawing a batch takes
    longer than learning it."""

    batch_size: int = 48
    learning_rate: float = 8.0e-4
    trunk_share: float = 0.2
    warmup_steps: int = 150
    weight_decay: float = 0.01
    average_decay: float = 0.998
    nonlinear_weight: float = 2.5
    own_weight: float = 0.35
    gradient_limit: float = 20.0
    remembered: int = 300


@dataclass
class BranchCheckpoint:
    """A run at one moment; `lineset` names the checkpoint that the branch was trained beside."""

    shape: BranchShape
    model: dict[str, Tensor]
    average: dict[str, Tensor]
    optimiser: dict[str, Any]
    step: int
    samples: int
    seconds: float
    notes: dict[str, Any]

    def save(self, path: Path) -> None:
        """Written whole or not at all."""
        temporary = path.with_suffix(".tmp")
        torch.save({**vars(self), "shape": self.shape.to_dict()}, temporary)
        os.replace(temporary, path)

    @staticmethod
    def load(path: Path) -> BranchCheckpoint:
        content = torch.load(path, weights_only=False)
        return BranchCheckpoint(**{**content, "shape": BranchShape(**content["shape"])})

    def averaged_branch(self) -> PictureBranch:
        branch = PictureBranch(self.shape, self.average["basis"])
        branch.load_state_dict(self.average)
        branch.eval()
        return branch


class _Batches(Dataset[PictureBatch]):
    """Batch i, drawn anew whenever it is asked for."""

    def __init__(self, sampler: PictureSampler, size: int, seed: int) -> None:
        self._sampler, self._size, self._seed = sampler, size, seed

    def __getitem__(self, index: int) -> PictureBatch:
        cv2.setNumThreads(1)
        return self._sampler.draw(self._size, np.random.default_rng([self._seed, index]))


def batches(sampler: PictureSampler, size: int, seed: int, first: int, workers: int) -> Iterator[PictureBatch]:
    """Batches from number `first` on, endlessly, drawn by `workers` processes (0: by this one)."""
    indices = range(first, first + 10**7)
    loader = DataLoader(
        _Batches(sampler, size, seed),
        batch_size=None,
        sampler=indices,
        num_workers=workers,
        prefetch_factor=4 if workers else None,
        collate_fn=_unchanged,
    )
    return iter(loader)


def _unchanged(batch: PictureBatch) -> PictureBatch:
    return batch


class BranchRun:
    """A training run in memory."""

    def __init__(self, checkpoint: BranchCheckpoint, lineset: LinesetNetwork, recipe: BranchRecipe) -> None:
        self.recipe = recipe
        self.lineset = lineset.eval()
        self.branch = PictureBranch(checkpoint.shape, checkpoint.model["basis"])
        self.branch.load_state_dict(checkpoint.model)
        self.branch.to(memory_format=torch.channels_last)
        self.average = PictureBranch(checkpoint.shape, checkpoint.model["basis"])
        self.average.load_state_dict(checkpoint.average)
        inherited = (self.branch.trunk, self.branch.summarise, self.branch.guides)
        trunk = [p for module in inherited for p in module.parameters()]
        known = {id(p) for p in trunk}
        self.parameters = list(self.branch.parameters())
        rest = [p for p in self.parameters if id(p) not in known]
        self.optimiser = torch.optim.AdamW(
            [{"params": trunk, "share": recipe.trunk_share}, {"params": rest, "share": 1.0}],
            lr=recipe.learning_rate,
            betas=(0.9, 0.98),
            weight_decay=recipe.weight_decay,
        )
        if checkpoint.optimiser:
            self.optimiser.load_state_dict(checkpoint.optimiser)
        self.step, self.samples = checkpoint.step, checkpoint.samples
        self.seconds, self.notes = checkpoint.seconds, checkpoint.notes

    def checkpoint(self) -> BranchCheckpoint:
        return BranchCheckpoint(
            shape=self.branch.shape,
            model=self.branch.state_dict(),
            average=self.average.state_dict(),
            optimiser=self.optimiser.state_dict(),
            step=self.step,
            samples=self.samples,
            seconds=self.seconds,
            notes=self.notes,
        )

    def learn(self, drawn: PictureBatch, rate_scale: float) -> dict[str, Tensor]:
        """One step; errors (B,), px, of all and of the nonlinear part, before (line-set alone) and after."""
        batch, recipe = drawn.batch, self.recipe
        warm = min(1.0, (1 + self.step) / recipe.warmup_steps)
        for group in self.optimiser.param_groups:
            group["lr"] = recipe.learning_rate * rate_scale * warm * group["share"]
        truth = Truth(*(torch.from_numpy(a) for a in (batch.source, batch.target, batch.weight, batch.slopes)))
        values, spreads, state = said_by_chains(self.lineset, batch)
        view = (torch.from_numpy(drawn.views).float() / 255)[:, None].contiguous(memory_format=torch.channels_last)
        extent = torch.from_numpy(batch.points.half_extent)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            fused, errors, own = self.branch(view, extent, values, spreads, state)
        overall, nonlinear = truth.errors(fused)
        own_overall, own_nonlinear = truth.errors(own)
        weight = recipe.nonlinear_weight
        loss = (tempered(overall) + weight * tempered(nonlinear)).mean()
        loss = loss + recipe.own_weight * (tempered(own_overall) + weight * tempered(own_nonlinear)).mean()
        logs = errors.clamp(-4, 5)
        seen = torch.stack([overall, nonlinear], 1).detach()
        loss = loss + 0.5 * (seen * torch.exp(-logs) + logs).mean()
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.parameters, recipe.gradient_limit)
        self.optimiser.step()
        self.step += 1
        decay = min(recipe.average_decay, (1 + self.step) / (20 + self.step))
        with torch.no_grad():
            torch._foreach_lerp_(list(self.average.parameters()), self.parameters, 1 - decay)
            before_overall, before = truth.errors(values)
        return {
            "all_before": before_overall,
            "all": overall.detach(),
            "all_own": own_overall.detach(),
            "nonlinear_before": before,
            "nonlinear": nonlinear.detach(),
            "nonlinear_own": own_nonlinear.detach(),
        }


@torch.no_grad()
def said_by_chains(lineset: LinesetNetwork, batch: TrainingBatch) -> tuple[Tensor, Tensor, Tensor]:
    """Node values, spreads and state of the line-set network."""
    features, layout = packed_input(batch)
    estimates, spreads, state = lineset.examined(features, layout)
    return estimates[-1], spreads, state


def train_branch(
    run: BranchRun,
    sampler: PictureSampler,
    directory: Path,
    *,
    name: str,
    seed: int,
    minutes: float | None,
    steps: int | None = None,
    cooling: bool = False,
    workers: int = 1,
) -> None:
    """Learns for so many more minutes or steps, saving to `directory`/`name`.pt; with `cooling` the rate falls to 0."""
    asked: list[int] = []
    previous = {s: signal.signal(s, lambda number, _: asked.append(number)) for s in (signal.SIGTERM, signal.SIGINT)}
    sums: dict[str, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    began = reported = saved = time.monotonic()
    before, first_step, reported_samples = run.seconds, run.step, run.samples
    remembered: deque[PictureBatch] = deque(maxlen=run.recipe.remembered)
    order = np.random.default_rng([seed, run.step, 1])
    for drawn in batches(sampler, run.recipe.batch_size, seed, run.step, workers):
        elapsed = time.monotonic() - began
        done = max(elapsed / 60 / minutes if minutes else 0.0, (run.step - first_step) / steps if steps else 0.0)
        if done >= 1 or asked:
            break
        errors = run.learn(drawn, 1 - done if cooling else 1.0)
        run.samples += len(drawn.batch.kind)
        if remembered:
            run.learn(remembered[int(order.integers(len(remembered)))], 1 - done if cooling else 1.0)
        remembered.append(drawn)
        run.seconds = before + time.monotonic() - began
        for key, values in errors.items():
            for kind, value in zip(drawn.batch.kind.tolist(), values.tolist(), strict=True):
                sums[key][kind].append(value)
        if time.monotonic() - reported > REPORT_EVERY_S:
            interval = time.monotonic() - reported
            line = _report(run, sums, (run.samples - reported_samples) / interval)
            with open(directory / f"{name}.jsonl", "a") as file:
                file.write(line + "\n")
            print(line, flush=True)
            sums.clear()
            reported, reported_samples = time.monotonic(), run.samples
        if time.monotonic() - saved > SAVE_EVERY_S:
            run.checkpoint().save(directory / f"{name}.pt")
            saved = time.monotonic()
    run.checkpoint().save(directory / f"{name}.pt")
    for number, handler in previous.items():
        signal.signal(number, handler)


def _report(run: BranchRun, sums: dict[str, dict[int, list[float]]], samples_per_s: float) -> str:
    means = {key: round(float(np.mean([e for v in kinds.values() for e in v])), 3) for key, kinds in sums.items()}
    kinds = {KINDS[k]: [round(float(np.mean(sums[key][k])), 2) for key in _REPORTED] for k in sorted(sums["all"])}
    line = {
        "minutes": round(run.seconds / 60, 2),
        "step": run.step,
        "samples": run.samples,
        **means,
        "samples_per_s": round(samples_per_s, 1),
        "by_kind": kinds,
    }
    return json.dumps(line)


def new_branch_checkpoint(
    lineset: LinesetNetwork, first: Path | None, notes: dict[str, Any], shape: BranchShape | None = None
) -> BranchCheckpoint:
    """Step zero: random weights, or those of the first network where they fit."""
    torch.manual_seed(int(notes.get("seed", 0)))
    shape = shape or BranchShape(state=lineset.shape.global_width)
    branch = PictureBranch(shape, lineset.basis.clone())
    if first is not None:
        from training.picture_start import begin_with_first

        begin_with_first(branch, first)
    state = branch.state_dict()
    return BranchCheckpoint(branch.shape, state, copy.deepcopy(state), {}, 0, 0, 0.0, notes)
