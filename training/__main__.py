"""`python -m training VERB`: chains and scenes, runs, calibration, export, measures (training/README.md)."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from training.picture_commands import add_branch_verbs
from training.together_commands import add_together_verbs
from training.vgg_commands import add_verbs as add_vgg_verbs

if TYPE_CHECKING:
    from training.loop import Recipe

DEFAULT_DIRECTORY = Path.home() / ".cache" / "unbend" / "training"
DEFAULT_PHOTOS = Path("../shared/photos")
MALLOC = {
    # glibc's defaults return every large tensor to the system and fault it in again: half of the time was lost there.
    "MALLOC_MMAP_THRESHOLD_": "33554432",
    "MALLOC_TRIM_THRESHOLD_": "2000000000",
    "MALLOC_TOP_PAD_": "67108864",
    "GLIBC_TUNABLES": "glibc.malloc.hugetlb=1",
}


def main() -> None:
    arguments = _parser().parse_args()
    if sys.platform == "linux" and any(os.environ.get(name) != value for name, value in MALLOC.items()):
        # Read by the allocator at start-up only, hence the new start.
        threads = {"OMP_NUM_THREADS": str(arguments.threads), "OPENBLAS_NUM_THREADS": str(arguments.threads)}
        os.execve(
            sys.executable, [sys.executable, "-m", "training", *sys.argv[1:]], {**os.environ, **MALLOC, **threads}
        )
    import cv2
    import torch

    cv2.setNumThreads(arguments.threads)
    torch.set_num_threads(arguments.threads)
    verb: Callable[[argparse.Namespace], None] = arguments.verb
    verb(arguments)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m training", description=__doc__)
    parser.add_argument("--directory", type=Path, default=DEFAULT_DIRECTORY, help="checkpoints, store, logs")
    parser.add_argument("--photos", type=Path, default=DEFAULT_PHOTOS, help="photographs with their index.csv")
    parser.add_argument("--threads", type=int, default=1)
    verbs = parser.add_subparsers(required=True)

    store = verbs.add_parser("store", help="extract the chains of all training pictures, once")
    store.add_argument("--scenes", type=int, default=900, help="drawn scenes to add")
    store.add_argument("--vistas", type=int, default=0, help="drawn scenes with furniture, plants and people to add")
    store.add_argument("--free-only", action="store_true", help="drawn scenes and CC0 photographs only")
    store.set_defaults(verb=_store)

    scenes = verbs.add_parser("scenes", help="write drawn scenes as PNG, for `unbend eval --scenes`")
    scenes.add_argument("folder", type=Path)
    scenes.add_argument("--count", type=int, default=100)
    scenes.add_argument("--seed", type=int, default=99, help="1 and 7 are those of the training runs")
    scenes.add_argument("--vistas", action="store_true", help="with furniture, plants and people")
    scenes.set_defaults(verb=_scenes)

    train = verbs.add_parser("train", help="start the long run, or go on with it")
    train.add_argument("--name", default="run")
    train.add_argument("--minutes", type=float)
    train.add_argument("--steps", type=int)
    train.add_argument("--seed", type=int, default=0)
    train.add_argument("--learning-rate", type=float)
    train.add_argument("--inherit", type=Path, help="research checkpoint to begin with")
    train.set_defaults(verb=_train)

    cooldown = verbs.add_parser("cooldown", help="bring a copy of the run to rest; the run itself stays as it is")
    cooldown.add_argument("--name", default="run")
    cooldown.add_argument("--minutes", type=float, default=30)
    cooldown.add_argument("--learning-rate", type=float, help="to begin with")
    cooldown.add_argument("--steps", type=int)
    cooldown.set_defaults(verb=_cooldown)

    plot = verbs.add_parser("plot", help="draw the training curve")
    plot.add_argument("--name", default="run")
    plot.set_defaults(verb=_plot)

    export = verbs.add_parser("export", help="write a checkpoint as ONNX with its card, checked against torch")
    export.add_argument("--name", default="run-cooled")
    export.add_argument("--weights", type=Path, default=Path("service/unbend_service/models/lineset.onnx"))
    export.add_argument("--calibration", type=Path, help="the .json that `calibrate` wrote")
    export.add_argument("--min-confidence", type=float, default=0.8, help="below it nothing is to be corrected")
    export.add_argument("--full-confidence", type=float, help="from it on all of it (default: the same)")
    export.add_argument("--doubtful-px", type=float, default=0.0, help="between them this much; px at 256")
    export.set_defaults(verb=_export)

    calibrate = verbs.add_parser("calibrate", help="fit the confidence of a checkpoint on training photographs")
    calibrate.add_argument("--name", default="run-cooled")
    calibrate.add_argument("--limit", type=int, default=150, help="photographs per family")
    calibrate.set_defaults(verb=_calibrate)

    for verb in (export, calibrate):
        verb.add_argument("--branch", help="checkpoint of the picture branch to go with it")
    add_branch_verbs(verbs)
    add_together_verbs(verbs)

    evaluate = verbs.add_parser("evaluate", help="measure exported weights, or a checkpoint, on validation pictures")
    evaluate.add_argument("--weights", type=Path, help="an exported .onnx; otherwise --name's checkpoint is exported")
    evaluate.add_argument("--name", default="run")
    evaluate.add_argument("--limit", type=int, default=48, help="photographs per family")
    evaluate.add_argument("--threshold", type=float, help="of confidence, in place of the card's advice")
    evaluate.set_defaults(verb=_evaluate)
    add_vgg_verbs(verbs)
    return parser


def _store(arguments: argparse.Namespace) -> None:
    from training import vistas
    from training.chain_store import FREE_SOURCES, build_store, drawn_scenes, training_photographs

    sources = FREE_SOURCES if arguments.free_only else None
    pictures = chain(
        training_photographs(arguments.photos, sources),
        drawn_scenes(arguments.scenes, seed=1),
        drawn_scenes(arguments.vistas, seed=1, draw=vistas.draw_scene),
    )
    store = build_store(pictures)
    store.save(arguments.directory / "chains.npz")
    print(f"{store.pictures} pictures, {len(store.x)} points -> {arguments.directory / 'chains.npz'}")


def _scenes(arguments: argparse.Namespace) -> None:
    import cv2

    from training import scenes, vistas
    from training.chain_store import drawn_scenes

    arguments.folder.mkdir(parents=True, exist_ok=True)
    draw = vistas.draw_scene if arguments.vistas else scenes.draw_scene
    for number, (_, grey) in enumerate(drawn_scenes(arguments.count, arguments.seed, draw=draw)):
        cv2.imwrite(str(arguments.folder / f"{number:04}.png"), grey)


def _train(arguments: argparse.Namespace) -> None:
    from training.chain_store import ChainStore
    from training.checkpoints import Checkpoint
    from training.loop import Recipe, Run, default_shape, new_checkpoint, train
    from training.sampler import Sampler

    directory: Path = arguments.directory
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "train.pid").write_text(str(os.getpid()))
    sampler = Sampler(ChainStore.load(directory / "chains.npz"))
    path = directory / f"{arguments.name}.pt"
    if path.exists():
        checkpoint = Checkpoint.load(path)
    else:
        checkpoint = new_checkpoint(sampler, default_shape(), arguments.seed, arguments.inherit)
    train(
        Run(checkpoint, _recipe(arguments, Recipe().warmup_steps)),
        sampler,
        directory,
        name=arguments.name,
        minutes=arguments.minutes,
        steps=arguments.steps,
    )


def _cooldown(arguments: argparse.Namespace) -> None:
    from training.chain_store import ChainStore
    from training.checkpoints import Checkpoint
    from training.loop import Run, train
    from training.sampler import Sampler

    directory: Path = arguments.directory
    (directory / "train.pid").write_text(str(os.getpid()))
    run = Run(Checkpoint.load(directory / f"{arguments.name}.pt"), _recipe(arguments, warmup_steps=0))
    train(
        run,
        Sampler(ChainStore.load(directory / "chains.npz")),
        directory,
        name=f"{arguments.name}-cooled",
        minutes=arguments.minutes if arguments.steps is None else None,
        steps=arguments.steps,
        cooling=True,
    )


def _recipe(arguments: argparse.Namespace, warmup_steps: int) -> Recipe:
    from training.loop import Recipe

    recipe = Recipe(warmup_steps=warmup_steps)
    return recipe if arguments.learning_rate is None else replace(recipe, learning_rate=arguments.learning_rate)


def _plot(arguments: argparse.Namespace) -> None:
    from training.curve import plot_curve

    directory: Path = arguments.directory
    plot_curve(directory / f"{arguments.name}.jsonl", directory / f"{arguments.name}.png")


def _export(arguments: argparse.Namespace) -> None:
    from training.checkpoints import Checkpoint
    from training.export import UNCALIBRATED, export
    from unbend_service.domain.decision import Caution

    least, doubtful_px = arguments.min_confidence, arguments.doubtful_px
    full = least if arguments.full_confidence is None else arguments.full_confidence
    confidence = UNCALIBRATED
    if arguments.calibration is not None:
        confidence = tuple(json.loads(arguments.calibration.read_text())["weights"])
    checkpoint = Checkpoint.load(arguments.directory / f"{arguments.name}.pt")
    weights: Path = arguments.weights
    caution = Caution(least, full, doubtful_px * 2 / 256)
    difference = export(checkpoint, weights, weights.stem, confidence=confidence, caution=caution)
    _export_branch(arguments, weights)
    print(f"{weights}: {checkpoint.samples} samples, differs from torch by {difference:.1e}")


def _export_branch(arguments: argparse.Namespace, weights: Path) -> None:
    if arguments.branch is None:
        return
    from training.picture_export import export_branch
    from training.picture_loop import BranchCheckpoint

    export_branch(BranchCheckpoint.load(arguments.directory / f"{arguments.branch}.pt"), weights)


def _calibrate(arguments: argparse.Namespace) -> None:
    from dataclasses import asdict

    from training.calibration import calibrate, gather, reliability_table
    from training.checkpoints import Checkpoint
    from training.export import export
    from unbend_service.adapters.estimators.cards import read_card
    from unbend_service.adapters.estimators.lineset import LinesetEstimator

    directory: Path = arguments.directory / "evaluations"
    weights = directory / f"{arguments.name}.onnx"
    export(Checkpoint.load(arguments.directory / f"{arguments.name}.pt"), weights)
    _export_branch(arguments, weights)
    estimator = LinesetEstimator(read_card(str(weights)), arguments.threads)
    calibration = calibrate(gather(estimator, arguments.photos, arguments.limit))
    path = arguments.directory / f"{arguments.name}-calibration.json"
    path.write_text(json.dumps(asdict(calibration), indent=2) + "\n")
    print(f"{path}\n{reliability_table(calibration.reliability)}")


def _evaluate(arguments: argparse.Namespace) -> None:
    from training.checkpoints import Checkpoint
    from training.evaluation import measure, measure_whole, table, write
    from training.export import export
    from training.protocol import photographs
    from unbend_service.adapters.estimators.catalogue import load_estimator
    from unbend_service.domain.decision import Caution

    directory: Path = arguments.directory / "evaluations"
    weights: Path | None = arguments.weights
    title = str(weights)
    if weights is None:
        checkpoint = Checkpoint.load(arguments.directory / f"{arguments.name}.pt")
        title = f"{arguments.name}, {checkpoint.samples / 1e6:.2f} M samples, {checkpoint.seconds / 3600:.2f} h"
        weights = directory / f"{arguments.name}.onnx"
        export(checkpoint, weights)
    estimator = load_estimator(str(weights), arguments.threads)
    pictures = photographs(arguments.photos, "val", arguments.limit)
    threshold = arguments.threshold
    caution = None if threshold is None else Caution(threshold, threshold)
    measured = measure(estimator, pictures, caution=caution) + measure_whole(estimator, pictures, caution)
    text = table(measured, title)
    write(text, directory / f"{weights.stem}-{arguments.limit}.md")
    print(text)


if __name__ == "__main__":
    main()
