"""`python -m training pack` and `together`: both networks at once, on a GPU beside many cores."""

from __future__ import annotations

import argparse
import itertools
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from training.checkpoints import Checkpoint
    from training.drawing import Drawn
    from training.picture_loop import BranchCheckpoint
    from training.picture_pack import PicturePack
    from training.sampler import Sampler

TRAINING, HELD_OUT = "", "-held-out"
_HELD_OUT_BATCHES = {"imitated": 512, "extracted": 192}


def add_together_verbs(verbs: Any) -> None:
    """Adds both verbs to the parser of `training`."""
    pack = verbs.add_parser("pack", help="chains and pictures of all photographs and drawn scenes, for `together`")
    pack.add_argument("--scenes", type=int, default=900, help="drawn scenes to add")
    pack.add_argument("--vistas", type=int, default=0, help="drawn scenes with furniture, plants and people to add")
    pack.add_argument("--more-photos", type=Path, action="append", default=[], help="a further folder of photographs")
    pack.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    pack.set_defaults(verb=_pack)
    together = verbs.add_parser("together", help="train both networks at once, or go on with it")
    together.add_argument("--name", default="together")
    together.add_argument("--source", action="append", help="photographs to learn from; all if none is named")
    together.add_argument("--minutes", type=float, help="without end unless given; stop it whenever you like (SIGTERM)")
    together.add_argument("--rates", type=float, nargs=2, default=(1.0, 1.0), help="first and last share of the rate")
    cores = os.cpu_count() or 1
    together.add_argument("--imitated", type=int, default=max(1, cores - 1), help="processes that warp chains")
    together.add_argument("--extracted", type=int, default=0, help="processes that warp pictures and search them")
    together.add_argument("--batch-size", type=int, default=256)
    together.add_argument("--extracted-batch-size", type=int, default=128)
    together.add_argument("--drawn-share", type=float, default=0.22)
    together.add_argument("--chain-width", type=int, default=192)
    together.add_argument("--device", help="cuda, or cpu; unless given, a GPU if there is one")
    together.add_argument("--seed", type=int, default=0)
    together.set_defaults(verb=_together)


def _pack(arguments: argparse.Namespace) -> None:
    from training import vistas
    from training.chain_store import build_store, drawn_scenes, training_photographs
    from training.picture_pack import PicturePack

    folders = [arguments.photos, *arguments.more_photos]
    taken = itertools.chain.from_iterable(training_photographs(folder) for folder in folders)
    drawn = itertools.chain(
        drawn_scenes(arguments.scenes, seed=1, processes=arguments.processes),
        drawn_scenes(arguments.vistas, seed=1, processes=arguments.processes, draw=vistas.draw_scene),
    )
    for suffix, pictures in (
        (HELD_OUT, list(training_photographs(arguments.photos, split="val"))),
        (TRAINING, list(itertools.chain(taken, drawn))),
    ):
        PicturePack.of(pictures).save(arguments.directory / f"pictures{suffix}.npz")
        build_store(pictures, arguments.processes).save(arguments.directory / f"chains{suffix}.npz")
        print(f"{len(pictures)} pictures{suffix}", flush=True)


def _together(arguments: argparse.Namespace) -> None:
    import torch

    from training.atlas import Atlas
    from training.chain_store import ChainStore
    from training.drawing import Draw, Drawing, extracted, imitated
    from training.picture_pack import PicturePack
    from training.picture_sampler import PictureSampler
    from training.sampler import Sampler
    from training.together import TogetherRecipe, TogetherRun, train_together

    directory: Path = arguments.directory
    sources = None if arguments.source is None else tuple(arguments.source)
    pack = PicturePack.load(directory / "pictures.npz")
    store = ChainStore.load(directory / "chains.npz")
    sampler = Sampler(store, drawn_share=arguments.drawn_share, sources=sources)
    draws: list[Draw] = [imitated(sampler, arguments.batch_size)] * arguments.imitated
    if arguments.extracted:
        chosen = pack.only(sources, arguments.drawn_share)
        draws += [extracted(PictureSampler(chosen), arguments.extracted_batch_size)] * arguments.extracted
    lineset, branch = _checkpoints(sampler, arguments)
    held_out_pack = PicturePack.load(directory / "pictures-held-out.npz")
    held_out = _held_out(directory, held_out_pack, len(pack.pictures))
    # The processes that draw are forked before anything touches the GPU.
    drawing = Drawing(draws, arguments.seed * 1_000_003 + branch.step)
    device = torch.device(arguments.device or ("cuda" if torch.cuda.is_available() else "cpu"))
    if device.type == "cuda":
        torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = True
    run = TogetherRun(lineset, branch, TogetherRecipe(), device, arguments.seed)
    atlas = Atlas([*pack.pictures, *held_out_pack.pictures], device)
    train_together(
        run, drawing, atlas, held_out, directory,
        name=arguments.name, minutes=arguments.minutes, rates=tuple(arguments.rates),
    )  # fmt: skip
    drawing.stop()


def _checkpoints(sampler: Sampler, arguments: argparse.Namespace) -> tuple[Checkpoint, BranchCheckpoint]:
    """Of the run so far, or of one that begins with nothing."""
    from dataclasses import replace

    from training.checkpoints import Checkpoint
    from training.loop import default_shape, new_checkpoint
    from training.picture_loop import BranchCheckpoint, new_branch_checkpoint
    from training.picture_network import BranchShape

    paths = [arguments.directory / f"{arguments.name}{suffix}.pt" for suffix in ("", "-branch")]
    if paths[1].exists():
        return Checkpoint.load(paths[0]), BranchCheckpoint.load(paths[1])
    lineset = new_checkpoint(sampler, replace(default_shape(), chain_width=arguments.chain_width), arguments.seed)
    lineset.notes.update(sources=arguments.source)
    shape = BranchShape(state=lineset.shape.global_width, widths=(32, 64, 128), hidden=320, depth=3)
    notes = {"seed": arguments.seed, "lineset": arguments.name, "sources": arguments.source}
    return lineset, new_branch_checkpoint(lineset.averaged_network(), None, notes, shape)


def _held_out(directory: Path, pack: PicturePack, first: int) -> list[Drawn]:
    """Batches of pictures that nobody learns from: chains imitated, and extracted. first: their index in the atlas."""
    import numpy as np

    from training.chain_store import ChainStore
    from training.drawing import Drawn, batch_tensors, extracted, imitated
    from training.picture_sampler import PictureSampler
    from training.sampler import Sampler

    sampler = Sampler(ChainStore.load(directory / "chains-held-out.npz"))
    batches = []
    for draw in (
        imitated(sampler, _HELD_OUT_BATCHES["imitated"]),
        extracted(PictureSampler(pack.pictures), _HELD_OUT_BATCHES["extracted"]),
    ):
        batch, seen = draw(np.random.default_rng(99))
        if "view_picture" in seen:
            seen["view_picture"] = seen["view_picture"] + first
        batches.append(Drawn({**batch_tensors(batch), **seen}, process=0, number=0, again=False))
    return batches
