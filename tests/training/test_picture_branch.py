from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from training.chain_store import build_store
from training.export import export
from training.loop import default_shape, new_checkpoint
from training.picture_export import export_branch
from training.picture_loop import BranchCheckpoint, BranchRecipe, BranchRun, new_branch_checkpoint, train_branch
from training.picture_network import BranchShape, PictureBranch
from training.picture_sampler import PictureSampler
from training.sampler import Sampler
from training.scenes import draw_scene
from unbend_service.adapters.estimators.catalogue import load_estimator
from unbend_service.adapters.estimators.views import VIEW_PX, view_of

pytestmark = pytest.mark.training

SCENES = [draw_scene(np.random.default_rng(seed)) for seed in range(4)]


@pytest.fixture(scope="module")
def lineset_checkpoint():
    sampler = Sampler(build_store(("drawn", scene) for scene in SCENES))
    return new_checkpoint(sampler, default_shape(), seed=0)


def fence() -> np.ndarray:
    """Straight bars on a wall."""
    wall = np.full((480, 640), 200, np.uint8)
    for x in range(20, 640, 40):
        cv2.line(wall, (x, 0), (x + 15, 479), 40, 5, cv2.LINE_AA)
    return wall


def test_chains_of_a_sample_are_straight_once_the_true_distortion_is_undone() -> None:
    """Picture, chains and truth of a sample speak of the same lens."""
    sampler = PictureSampler([fence()], tilt_share=0.0, square_share=1.0)
    drawn = sampler.draw(8, np.random.default_rng(4))
    points, batch = drawn.batch.points, drawn.batch
    bent, straight = [], []
    for one in range(8):
        inside = points.picture == one
        source = np.stack([points.x[inside], points.y[inside]], 1).astype(np.float64)
        found = _nearest_map(batch.source[one], batch.target[one], source)
        starts = np.flatnonzero(points.starts[inside])
        for chain in np.split(np.arange(inside.sum()), starts[1:]):
            if len(chain) > 12:
                bent.append(_bend(source[chain]))
                straight.append(_bend(found[chain]))
    assert len(bent) > 20
    assert np.mean(straight) < 0.35 * np.mean(bent)


def _nearest_map(source: np.ndarray, target: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Where the true map takes points: a smooth fit through its correspondences."""

    def powers(at: np.ndarray) -> np.ndarray:
        x, y = at.T
        return np.stack([x**i * y**j for i in range(8) for j in range(8 - i)], 1)

    near = (np.abs(target) < 2).all(1)
    return powers(points) @ np.linalg.lstsq(powers(source[near]), target[near], rcond=None)[0]


def _bend(chain: np.ndarray) -> float:
    """Distance of the middle from the chord, over its length."""
    along = chain[-1] - chain[0]
    away = chain[len(chain) // 2] - chain[0]
    return abs(along[0] * away[1] - along[1] * away[0]) / (along @ along)


def test_the_same_generator_draws_the_same_sample() -> None:
    sampler = PictureSampler(SCENES)
    one, other = (sampler.draw(3, np.random.default_rng(9)) for _ in range(2))
    assert np.array_equal(one.views, other.views)
    assert one.batch.chains.features == pytest.approx(other.batch.chains.features, abs=1e-3)


def test_a_view_holds_the_whole_picture_unsquashed() -> None:
    """A wide picture lies in the middle, its mean above and below."""
    view = view_of(np.repeat(np.linspace(0, 255, 320).astype(np.uint8)[None], 160, 0))
    assert view.shape == (VIEW_PX, VIEW_PX)
    assert np.ptp(view[: VIEW_PX // 4 - 1]) == 0
    assert view[VIEW_PX // 2, -1] - view[VIEW_PX // 2, 0] > 0.95


def test_before_it_has_learned_the_branch_follows_the_chains(lineset_checkpoint) -> None:
    branch = PictureBranch(BranchShape(), lineset_checkpoint.average["basis"])
    values = branch.straight + 0.05 * torch.randn(2, 72, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        fused, _, _ = branch(
            torch.rand(2, 1, 192, 192), torch.ones(2, 2), values, torch.zeros(2, 74), torch.zeros(2, 256)
        )
    assert (fused - values).abs().max() < 0.4 * (values - branch.straight).abs().max()


def test_it_learns_resumes_exports_and_runs_in_the_service(lineset_checkpoint, tmp_path: Path) -> None:
    """A few steps in two goes; the service loads what was exported and looks with it."""
    lineset = lineset_checkpoint.averaged_network()
    sampler = PictureSampler(SCENES)
    checkpoint = new_branch_checkpoint(lineset, None, {"seed": 0})
    recipe = BranchRecipe(batch_size=4)
    for steps in (2, 2):
        run = BranchRun(checkpoint, lineset, recipe)
        train_branch(run, sampler, tmp_path, name="branch", seed=1, minutes=None, steps=steps, workers=0)
        checkpoint = BranchCheckpoint.load(tmp_path / "branch.pt")
    assert checkpoint.step >= 4
    assert all(bool(torch.isfinite(value).all()) for value in checkpoint.model.values())

    weights = tmp_path / "joint.onnx"
    export(lineset_checkpoint, weights)
    export_branch(checkpoint, weights)

    card = json.loads(weights.with_suffix(".json").read_text())
    assert card["parameters"]["branch"]["weights"] == "joint-picture.onnx"
    estimate = load_estimator(str(weights)).estimate(SCENES[0])
    assert 0 <= estimate.confidence <= 1
