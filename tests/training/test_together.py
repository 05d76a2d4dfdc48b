from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from training.atlas import Atlas
from training.chain_store import build_store
from training.checkpoints import Checkpoint
from training.drawing import Drawing, imitated
from training.export import export
from training.labels import STRAIGHT
from training.picture_export import export_branch
from training.picture_loop import BranchCheckpoint
from training.picture_pack import PicturePack
from training.sampler import Sampler
from training.scenes import draw_scene
from training.together_commands import add_together_verbs
from unbend_service.adapters.estimators.catalogue import load_estimator
from unbend_service.adapters.estimators.views import VIEW_PX

pytestmark = pytest.mark.training

SCENES = [draw_scene(np.random.default_rng(seed)) for seed in range(3)]
PROCESSOR = torch.device("cpu")


@pytest.fixture(scope="module")
def sampler() -> Sampler:
    return Sampler(build_store([("drawn", scene) for scene in SCENES], processes=2))


def test_a_view_shows_the_edges_where_the_chains_of_the_sample_are(sampler: Sampler) -> None:
    """Chains are warped on the processor, the picture on the device that trains; both speak of one picture."""
    batch, seen = imitated(sampler, 24)(np.random.default_rng(3))
    specs = {name.removeprefix("view_"): tensor for name, tensor in seen.items()}
    extent = torch.from_numpy(batch.points.half_extent)
    views = Atlas(SCENES, PROCESSOR).views(specs, extent, torch.Generator().manual_seed(0))[:, 0].numpy()
    assert views.shape == (24, VIEW_PX, VIEW_PX)
    on_chains, anywhere = [], []
    for one, view in enumerate(views):
        edges = cv2.GaussianBlur(np.hypot(*np.gradient(cv2.GaussianBlur(view, (0, 0), 1))), (0, 0), 0.7)
        mine = batch.points.picture == one
        column = ((batch.points.x[mine] + 1) * VIEW_PX / 2).astype(int)
        row = ((batch.points.y[mine] + 1) * VIEW_PX / 2).astype(int)
        if len(row) > 40:
            on_chains.append(edges[row, column].mean())
            anywhere.append(edges.mean())
    assert len(on_chains) > 12
    assert np.mean(np.array(on_chains) > 1.6 * np.array(anywhere)) > 0.85


def test_beside_a_picture_its_view_shows_its_mean(sampler: Sampler) -> None:
    batch, seen = imitated(sampler, 24)(np.random.default_rng(3))
    specs = {name.removeprefix("view_"): tensor for name, tensor in seen.items()}
    extent = torch.from_numpy(batch.points.half_extent)
    views = Atlas(SCENES, PROCESSOR).views(specs, extent, torch.Generator().manual_seed(0))[:, 0]
    wide = int(torch.nonzero(extent[:, 1] < 0.8)[0])
    beside = views[wide, :3]
    inside = round(float(extent[wide, 1]) * VIEW_PX / 2)
    assert float(beside.max() - beside.min()) == 0
    assert float(beside.mean()) == pytest.approx(
        float(views[wide, VIEW_PX // 2 - inside : VIEW_PX // 2 + inside].mean()), abs=0.01
    )


def test_processes_draw_and_look_again(sampler: Sampler) -> None:
    """Every process draws its own batches; the second look at one of them comes when it is asked for, and nothing
    hangs when requests are still waiting at the end."""
    drawing = Drawing([imitated(sampler, 8)] * 2, seed=4)
    try:
        batches = iter(drawing)
        first = next(batches)
        straight = torch.from_numpy(STRAIGHT).float().expand(8, -1)
        drawing.look_again(first, straight)
        seen = [first]
        while not (any(drawn.again for drawn in seen) and len({drawn.process for drawn in seen}) == 2):
            seen.append(next(batches))
            assert len(seen) < 200
        (back,) = (drawn for drawn in seen if drawn.again)
        assert (back.process, back.number) == (first.process, first.number)
        again, once = back.tensors, first.tensors
        # Guides that leave everything where it is show the same picture again.
        assert torch.allclose(again["source"], once["source"], atol=1e-3)
        assert torch.equal(again["target"], once["target"])
        for _ in range(40):
            drawing.look_again(first, straight)
    finally:
        drawing.stop()


def test_both_networks_learn_go_on_and_serve(tmp_path: Path) -> None:
    """`together` starts a run, goes on with it, and what it leaves is exported and estimates."""
    directory = tmp_path / "run"
    for suffix in ("", "-held-out"):
        pictures = [("drawn", scene) for scene in SCENES]
        PicturePack.of(pictures).save(directory / f"pictures{suffix}.npz")
        build_store(pictures).save(directory / f"chains{suffix}.npz")
    command = "together --minutes 0.02 --imitated 1 --batch-size 8 --device cpu --chain-width 32"
    _train(directory, command)
    begun = BranchCheckpoint.load(directory / "together-branch.pt")
    _train(directory, command + " --extracted 1 --extracted-batch-size 4 --rates 0.5 0")
    lineset, branch = (
        Checkpoint.load(directory / "together.pt"),
        BranchCheckpoint.load(directory / "together-branch.pt"),
    )
    assert branch.step > begun.step > 0
    assert branch.samples == lineset.samples > begun.samples
    assert not torch.equal(branch.model["summarise.weight"], begun.model["summarise.weight"])
    weights = tmp_path / "model.onnx"
    export(lineset, weights)
    export_branch(branch, weights)
    estimate = load_estimator(str(weights), 1).estimate(SCENES[0])
    assert 0 <= estimate.confidence <= 1


def test_pictures_of_chosen_sources_alone_are_learned_from() -> None:
    """The store holds all pictures; a run on free ones draws from no other."""
    store = build_store([("free", SCENES[0]), ("other", SCENES[1]), ("drawn", SCENES[2])])
    drawn = Sampler(store, drawn_share=0.3, sources=("free",)).draw_with_views(200, np.random.default_rng(0))[1]
    assert set(drawn.picture.tolist()) == {0, 2}


def _train(directory: Path, command: str) -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--directory", type=Path)
    add_together_verbs(parser.add_subparsers(required=True))
    arguments = parser.parse_args(["--directory", str(directory), *command.split()])
    arguments.verb(arguments)
