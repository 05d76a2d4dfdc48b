"""The line-set network and the picture branch, trained together: every batch shows both the chains and the pictures.

Made for a GPU beside many processor cores, which draw the batches (`drawing`). The line-set network learns from its
own answer and from the first and the second look; the branch and the fusion head learn beside it, and what they need
to know of the chains may shape the line-set network's state, but not its answer.
"""

# mypy: disallow-untyped-decorators=False
# (types are also checked where torch is not installed)
from __future__ import annotations

import json
import signal
import time
from collections import defaultdict, deque
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from training.atlas import Atlas
from training.checkpoints import Checkpoint
from training.drawing import Drawing, Drawn
from training.lineset_network import Layout, LinesetNetwork
from training.losses import Truth, spread_loss, tempered
from training.picture_loop import BranchCheckpoint
from training.picture_network import PictureBranch
from training.random_distortions import KINDS

REPORT_EVERY_S = 20.0
SAVE_EVERY_S = 120.0


@dataclass(frozen=True)
class TogetherRecipe:
    """nonlinear_weight: against 1 for the error of all. own_weight: of the branch's own guides, against 1 for the fused
    ones. second_look_share: of the batches are looked at again. remembered: batches of extracted chains of which one is
    learned again after every step, as drawing them takes far longer than learning them."""

    learning_rate: float = 1.0e-3
    warmup_steps: int = 500
    weight_decay: float = 0.01
    average_decay: float = 0.999
    nonlinear_weight: float = 2.5
    own_weight: float = 0.5
    gradient_limit: float = 20.0
    second_look_share: float = 0.25
    remembered: int = 600


class TogetherRun:
    """Both networks in the memory of a device."""

    def __init__(
        self, lineset: Checkpoint, branch: BranchCheckpoint, recipe: TogetherRecipe, device: torch.device, seed: int
    ) -> None:
        self.recipe, self.device = recipe, device
        self._lineset, self._branch = lineset, branch
        self.network, self.average = (_loaded(lineset, state, device) for state in (lineset.model, lineset.average))
        self.branch, self.branch_average = (
            _loaded_branch(branch, state, device) for state in (branch.model, branch.average)
        )
        self.optimiser = _optimiser(self.network, lineset.optimiser, recipe, device)
        self.branch_optimiser = _optimiser(self.branch, branch.optimiser, recipe, device)
        self.inverse_basis = torch.linalg.inv(self.network.basis)
        self.step, self.samples, self.seconds = branch.step, branch.samples, branch.seconds
        self.generator = torch.Generator(device).manual_seed(seed + self.step)

    def checkpoints(self) -> tuple[Checkpoint, BranchCheckpoint]:
        """The run at this moment."""
        lineset = replace(
            self._lineset,
            model=_on_processor(self.network), average=_on_processor(self.average),
            optimiser=self.optimiser.state_dict(), step=self.step, samples=self.samples, seconds=self.seconds,
        )  # fmt: skip
        branch = replace(
            self._branch,
            model=_on_processor(self.branch), average=_on_processor(self.branch_average),
            optimiser=self.branch_optimiser.state_dict(), step=self.step, samples=self.samples, seconds=self.seconds,
        )  # fmt: skip
        return lineset, branch

    def learn(self, told: dict[str, Tensor], views: Tensor | None, rate_scale: float) -> dict[str, Tensor]:
        """One step; errors (B,), px, `values` (B, 72) of the line-set network and `kind`. Without views the line-set
        network learns alone."""
        for optimiser in (self.optimiser, self.branch_optimiser):
            for group in optimiser.param_groups:
                warm = min(1.0, (1 + self.step) / self.recipe.warmup_steps)
                group["lr"] = self.recipe.learning_rate * rate_scale * warm
        loss, said = self._loss(told, views)
        self.optimiser.zero_grad(set_to_none=True)
        self.branch_optimiser.zero_grad(set_to_none=True)
        loss.backward()
        learners = [(self.network, self.average, self.optimiser)]
        if views is not None:
            learners.append((self.branch, self.branch_average, self.branch_optimiser))
        decay = min(self.recipe.average_decay, (1 + self.step) / (20 + self.step))
        for network, average, optimiser in learners:
            parameters = list(network.parameters())
            torch.nn.utils.clip_grad_norm_(parameters, self.recipe.gradient_limit)
            optimiser.step()
            with torch.no_grad():
                torch._foreach_lerp_(list(average.parameters()), parameters, 1 - decay)
        self.step += 1
        return said

    def _loss(self, told: dict[str, Tensor], views: Tensor | None) -> tuple[Tensor, dict[str, Tensor]]:
        weight = self.recipe.nonlinear_weight
        truth = Truth(told["source"], told["target"], told["weight"], told["slopes"])
        with torch.autocast(self.device.type, dtype=torch.bfloat16):
            estimates, spreads, state = self.network.examined(told["features"], packed_layout(told))
        values = estimates[-1]
        overall, nonlinear = truth.errors(values)
        loss = (tempered(overall) + weight * tempered(nonlinear)).mean()
        loss = loss + spread_loss(spreads, values, told["labels"], self.inverse_basis, overall, nonlinear)
        said = {"values": values, "kind": told["kind"], "chains_all": overall, "chains": nonlinear}
        if views is not None:
            with torch.autocast(self.device.type, dtype=torch.bfloat16):
                fused, errors, own = self.branch(views, told["extent"], values.detach(), spreads.detach(), state)
            fused_overall, fused_nonlinear = truth.errors(fused)
            own_overall, own_nonlinear = truth.errors(own)
            loss = loss + (tempered(fused_overall) + weight * tempered(fused_nonlinear)).mean()
            loss = loss + self.recipe.own_weight * (tempered(own_overall) + weight * tempered(own_nonlinear)).mean()
            logs = errors.clamp(-4, 5)
            seen = torch.stack([fused_overall, fused_nonlinear], 1).detach()
            loss = loss + 0.5 * (seen * torch.exp(-logs) + logs).mean()
            said |= {"all": fused_overall, "nonlinear": fused_nonlinear}
            said |= {"picture_all": own_overall, "picture": own_nonlinear}
        return loss, {name: tensor.detach() for name, tensor in said.items()}

    @torch.no_grad()
    def examined(self, told: dict[str, Tensor], views: Tensor) -> dict[str, float]:
        """Mean errors of the averaged networks on a batch they do not learn from."""
        truth = Truth(told["source"], told["target"], told["weight"], told["slopes"])
        estimates, spreads, state = self.average.examined(told["features"], packed_layout(told))
        fused, _, own = self.branch_average(views, told["extent"], estimates[-1], spreads, state)
        means: dict[str, float] = {}
        for name, values in (("chains", estimates[-1]), ("fused", fused), ("picture", own)):
            overall, nonlinear = truth.errors(values)
            means |= {f"{name}_all": float(overall.mean()), name: float(nonlinear.mean())}
        return means

    def save(self, directory: Path, name: str) -> None:
        lineset, branch = self.checkpoints()
        lineset.save(directory / f"{name}.pt")
        branch.save(directory / f"{name}-branch.pt")


def train_together(
    run: TogetherRun,
    drawing: Drawing,
    atlas: Atlas | None,
    held_out: list[Drawn],
    directory: Path,
    *,
    name: str,
    minutes: float | None,
    rates: tuple[float, float],
) -> None:
    """Learns for so many minutes, the rate going from rates[0] to rates[1] of the recipe's, or without end at rates[0];
    saves now and then, at the end, and when it is asked to stop (SIGTERM, SIGINT)."""
    asked: list[int] = []
    previous = {s: signal.signal(s, lambda number, _: asked.append(number)) for s in (signal.SIGTERM, signal.SIGINT)}
    began = reported = saved = time.monotonic()
    before, reported_samples, step = run.seconds, run.samples, 0
    sums: dict[str, list[Tensor]] = defaultdict(list)
    looks = run.recipe.second_look_share
    remembered: deque[tuple[dict[str, Tensor], Tensor]] = deque(maxlen=run.recipe.remembered)
    order = np.random.default_rng(run.step)
    for drawn in drawing:
        now = time.monotonic()
        done = (now - began) / 60 / minutes if minutes else 0.0
        if done >= 1 or asked:
            break
        told = drawn.to(run.device)
        views = None if drawn.again else seen(told, atlas, run.generator)
        rate = rates[0] + (rates[1] - rates[0]) * done
        said = run.learn(told, views, rate)
        if remembered:
            run.learn(*remembered[int(order.integers(len(remembered)))], rate)
        if views is not None and "views" in told:
            remembered.append((told, views))
        run.seconds = before + now - began
        step += 1
        if drawn.again:
            sums["again"].append(said["chains"])
            continue
        run.samples += len(said["kind"])
        if int(step * looks) != int((step - 1) * looks):
            drawing.look_again(drawn, said["values"])
        for key, errors in said.items():
            if key != "values":
                sums[key].append(errors)
        if now - reported > REPORT_EVERY_S:
            line = _report(run, sums, (run.samples - reported_samples) / (now - reported))
            for i, held in enumerate(held_out):
                there = held.to(run.device)
                means = run.examined(there, seen(there, atlas, torch.Generator(run.device).manual_seed(i)))
                line[f"held_out_{i}"] = {key: round(value, 3) for key, value in means.items()}
            text = json.dumps(line)
            with open(directory / f"{name}.jsonl", "a") as file:
                file.write(text + "\n")
            print(name, text, flush=True)
            sums.clear()
            reported, reported_samples = now, run.samples
        if now - saved > SAVE_EVERY_S:
            run.save(directory, name)
            saved = now
    run.save(directory, name)
    for number, handler in previous.items():
        signal.signal(number, handler)


def seen(told: dict[str, Tensor], atlas: Atlas | None, generator: torch.Generator) -> Tensor:
    """The views of a batch: those that came with it, or the atlas's."""
    if "views" in told:
        return (told["views"].float() / 255)[:, None].contiguous(memory_format=torch.channels_last)
    if atlas is None:
        raise ValueError("A batch without views needs an atlas of its pictures.")
    specs = {name.removeprefix("view_"): tensor for name, tensor in told.items() if name.startswith("view_")}
    return atlas.views(specs, told["extent"], generator).contiguous(memory_format=torch.channels_last)


def packed_layout(told: dict[str, Tensor]) -> Layout:
    """Where the chains of a batch lie."""
    size, slots = len(told["extent"]), int(told["slot"].max()) + 1
    place = told["picture"] * slots + told["slot"]
    mask = torch.zeros(size * slots, device=place.device).index_fill_(0, place, 1.0)
    return Layout(mask.view(size, slots), place, told["picture"])


def _report(run: TogetherRun, sums: dict[str, list[Tensor]], samples_per_s: float) -> dict[str, object]:
    errors = {key: torch.cat(parts).float().cpu().numpy() for key, parts in sums.items()}
    kinds = errors.pop("kind")
    return {
        "minutes": round(run.seconds / 60, 2),
        "step": run.step,
        "samples": run.samples,
        "samples_per_s": round(samples_per_s, 1),
        **{key: round(float(np.mean(values)), 3) for key, values in errors.items()},
        "by_kind": {
            KINDS[k]: [round(float(errors[key][kinds == k].mean()), 2) for key in ("chains", "nonlinear", "all")]
            for k in np.unique(kinds).astype(int).tolist()
        },
    }


def _loaded(checkpoint: Checkpoint, state: dict[str, Tensor], device: torch.device) -> LinesetNetwork:
    network = LinesetNetwork(checkpoint.shape)
    network.load_state_dict(state)
    network.to(device)
    return network


def _loaded_branch(checkpoint: BranchCheckpoint, state: dict[str, Tensor], device: torch.device) -> PictureBranch:
    branch = PictureBranch(checkpoint.shape, state["basis"])
    branch.load_state_dict(state)
    branch.to(device, memory_format=torch.channels_last)
    return branch


def _optimiser(
    network: nn.Module, state: dict[str, object], recipe: TogetherRecipe, device: torch.device
) -> torch.optim.Optimizer:
    matrices = [p for p in network.parameters() if p.ndim > 1]
    vectors = [p for p in network.parameters() if p.ndim <= 1]
    optimiser = torch.optim.AdamW(
        [{"params": matrices, "weight_decay": recipe.weight_decay}, {"params": vectors, "weight_decay": 0.0}],
        lr=recipe.learning_rate,
        betas=(0.9, 0.98),
        fused=device.type == "cuda",
    )
    if state:
        optimiser.load_state_dict(state)
    return optimiser


def _on_processor(network: nn.Module) -> dict[str, Tensor]:
    return {name: tensor.detach().cpu().contiguous() for name, tensor in network.state_dict().items()}
