"""A minute's training on a handful of drawn pictures: `make train-smoke`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from training.chain_store import ChainStore, build_store, drawn_scenes
from training.checkpoints import Checkpoint
from training.curve import plot_curve
from training.export import PARITY_TOLERANCE, export
from training.labels import STRAIGHT, fit_labels
from training.lineset_network import NetworkShape
from training.loop import Recipe, Run, new_checkpoint, train
from training.losses import Truth
from training.random_distortions import KINDS
from training.sampler import Sampler, TrainingBatch
from training.second_look import second_look
from training.straightening import Straightening
from unbend_service.adapters.estimators.chain_features import FEATURES

pytestmark = pytest.mark.training

SHAPE = NetworkShape(features=FEATURES, chain_width=24, queries=4, global_width=32)
RECIPE = Recipe(batch_size=24, learning_rate=2e-3, warmup_steps=5, bfloat16=False)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> ChainStore:
    path = tmp_path_factory.mktemp("store") / "chains.npz"
    build_store(drawn_scenes(4, seed=7)).save(path)
    return ChainStore.load(path)


@pytest.fixture(scope="module")
def start(store: ChainStore) -> Checkpoint:
    return new_checkpoint(Sampler(store), SHAPE, seed=0)


def test_a_batch_is_finite_and_reproducible(store: ChainStore) -> None:
    """The same generator draws the same samples; pictures of several aspects, chains of all of them."""
    one, other = (Sampler(store).draw(32, np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(one.chains.features, other.chains.features)
    assert np.isfinite(one.chains.features).all()
    assert np.isfinite(one.labels).all()
    assert len(np.unique(one.chains.picture)) > 20
    assert np.abs(one.source).max() <= 1


def test_a_resumed_run_is_the_run_that_never_stopped(store: ChainStore, start: Checkpoint, tmp_path: Path) -> None:
    """Model, average, optimiser and randomness all come back from the file."""
    whole = Run(start, RECIPE)
    train(whole, Sampler(store), tmp_path, name="whole", steps=6)
    half = Run(start, RECIPE)
    train(half, Sampler(store), tmp_path, name="half", steps=3)
    resumed = Run(Checkpoint.load(tmp_path / "half.pt"), RECIPE)
    resumed.warm_until = whole.warm_until
    train(resumed, Sampler(store), tmp_path, name="half", steps=3)
    assert (resumed.step, resumed.samples) == (whole.step, whole.samples) == (9, 6 * 24)
    for a, b in zip(whole.average.parameters(), resumed.average.parameters(), strict=True):
        torch.testing.assert_close(a, b)


def test_training_learns_and_cools_down(store: ChainStore, start: Checkpoint, tmp_path: Path) -> None:
    """A few steps on one batch lower its error; a cooldown ends at rate zero and leaves the run's file alone."""
    run = Run(start, RECIPE)
    batch = Sampler(store).draw(24, np.random.default_rng(1))
    first = float(run.learn(batch).overall.mean())
    for _ in range(40):
        last = float(run.learn(batch).overall.mean())
    assert last < 0.8 * first
    train(run, Sampler(store), tmp_path, name="run-cooled", steps=3, cooling=True)
    assert run.optimiser.param_groups[0]["lr"] < RECIPE.learning_rate / 2
    assert not (tmp_path / "run.pt").exists()


def test_a_second_look_sees_what_the_first_left(store: ChainStore) -> None:
    """Under true guides nothing is left: straight guides are right about the straightened chains."""
    batch = Sampler(store).draw(24, np.random.default_rng(3), np.full(24, KINDS.index("barrel")))
    x, y = batch.source[..., 0].astype(float), batch.source[..., 1].astype(float)
    s, t = batch.target[..., 0].astype(float), batch.target[..., 1].astype(float)
    true_values = torch.tensor(fit_labels(x, y, s, t, batch.weight.astype(float)), dtype=torch.float32)
    again = second_look(batch, true_values, Straightening())
    straight = torch.tensor(STRAIGHT, dtype=torch.float32).expand(24, -1)

    def error(seen: TrainingBatch) -> float:
        truth = Truth(*(torch.from_numpy(a) for a in (seen.source, seen.target, seen.weight, seen.slopes)))
        return float(truth.errors(straight)[0].mean())

    assert error(again) < 0.1 * error(batch)
    assert len(again.chains.features) > 0.8 * len(batch.chains.features)
    assert np.isfinite(again.chains.features).all()


def test_what_is_exported_computes_what_was_trained(start: Checkpoint, tmp_path: Path) -> None:
    """ONNX Runtime and torch agree, and the service's estimator loads the file and looks at a picture."""
    from training.scenes import draw_scene
    from unbend_service.adapters.estimators.catalogue import load_estimator

    weights = tmp_path / "tiny.onnx"
    assert export(start, weights, name="tiny") < PARITY_TOLERANCE
    estimate = load_estimator(str(weights), threads=1).estimate(draw_scene(np.random.default_rng(0)))
    assert estimate.model.name == "tiny"
    assert estimate.guides.rows.degree == 5


def test_the_curve_is_drawn_from_the_log(tmp_path: Path) -> None:
    """Each line of the log is a point of the curve."""
    line = '{"samples": %d, "epe": 4.0, "nonlinear": 0.9, "nonlinear_median": 0.5, "by_kind": {"barrel": [2.0, 0.5]}}\n'
    (tmp_path / "run.jsonl").write_text(line % 1000 + line % 2000)
    plot_curve(tmp_path / "run.jsonl", tmp_path / "run.png")
    assert (tmp_path / "run.png").stat().st_size > 1000
