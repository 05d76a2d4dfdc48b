"""`python -m training branch` and `branch-cooldown`: the picture branch beside a line-set network."""

from __future__ import annotations

import argparse
import itertools
import os
from pathlib import Path
from typing import Any


def add_branch_verbs(verbs: Any) -> None:
    """Adds both verbs to the parser of `training`."""
    branch = verbs.add_parser("branch", help="start the run of the picture branch, or go on with it")
    branch.add_argument("--first", type=Path, help="first.onnx, whose trunk it begins with")
    branch.add_argument("--minutes", type=float)
    branch.add_argument("--steps", type=int)
    cooldown = verbs.add_parser("branch-cooldown", help="bring a copy of that run to rest")
    cooldown.add_argument("--minutes", type=float, default=20)
    cooldown.add_argument("--steps", type=int)
    for verb, cooling in ((branch, False), (cooldown, True)):
        verb.add_argument("--lineset", default="run-cooled", help="checkpoint of the network it stands beside")
        verb.add_argument("--name", default="branch")
        verb.add_argument("--seed", type=int, default=5 if cooling else 4)
        verb.add_argument("--scenes", type=int, default=200, help="drawn scenes to add to the photographs")
        verb.add_argument("--workers", type=int, default=2, help="processes that draw samples; 0: none beside this")
        verb.set_defaults(verb=_cool if cooling else _train)


def _train(arguments: argparse.Namespace) -> None:
    _run(arguments, cooling=False)


def _cool(arguments: argparse.Namespace) -> None:
    _run(arguments, cooling=True)


def _run(arguments: argparse.Namespace, *, cooling: bool) -> None:
    from training.chain_store import drawn_scenes, training_photographs
    from training.checkpoints import Checkpoint
    from training.picture_loop import (
        BranchCheckpoint,
        BranchRecipe,
        BranchRun,
        new_branch_checkpoint,
        train_branch,
    )
    from training.picture_sampler import PictureSampler

    directory: Path = arguments.directory
    (directory / "train.pid").write_text(str(os.getpid()))
    lineset = Checkpoint.load(directory / f"{arguments.lineset}.pt").averaged_network()
    path = directory / f"{arguments.name}.pt"
    if cooling or path.exists():
        checkpoint = BranchCheckpoint.load(path)
    else:
        notes = {"seed": arguments.seed, "lineset": arguments.lineset}
        checkpoint = new_branch_checkpoint(lineset, arguments.first, notes)
    pictures = itertools.chain(training_photographs(arguments.photos), drawn_scenes(arguments.scenes, seed=7))
    train_branch(
        BranchRun(checkpoint, lineset, BranchRecipe()),
        PictureSampler([grey for _, grey in pictures]),
        directory,
        name=f"{arguments.name}-cooled" if cooling else arguments.name,
        seed=arguments.seed,
        minutes=arguments.minutes if arguments.steps is None else None,
        steps=arguments.steps,
        cooling=cooling,
        workers=arguments.workers,
    )
