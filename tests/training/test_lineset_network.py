from __future__ import annotations

import numpy as np
import pytest
import torch

from training.labels import (
    STRAIGHT,
    VALUES,
    evaluation_points,
    evaluation_weights,
    fit_labels,
)
from training.lineset_network import Layout, LinesetNetwork, NetworkShape
from training.losses import Truth
from training.random_distortions import fixed_distortion
from training.straightening import Straightening
from unbend_service.adapters.estimators.chain_features import FEATURES, ChainPoints, describe

pytestmark = pytest.mark.training

SQUARE = np.ones((1, 2))


def truth_of(distortion: object) -> tuple[torch.Tensor, Truth]:
    """Fitted labels and the truth of a batch of one, square."""
    x, y = evaluation_points(SQUARE)
    s, t = distortion.straighten(x, y)
    weight = evaluation_weights(s, t, np.ones_like(s), SQUARE)
    source, target = (torch.tensor(np.stack(p, -1), dtype=torch.float32) for p in ((x, y), (s, t)))
    slopes = torch.eye(2).expand(1, x.shape[1], 2, 2)
    labels = torch.tensor(fit_labels(x, y, s, t, weight), dtype=torch.float32)
    return labels, Truth(source, target, torch.tensor(weight, dtype=torch.float32), slopes)


def test_straight_guides_are_right_about_an_undistorted_picture() -> None:
    """Their error is nothing but the smoothing of the norm."""
    labels, truth = truth_of(fixed_distortion())
    assert labels.numpy()[0] == pytest.approx(STRAIGHT, abs=1e-4)
    assert truth.errors(labels)[0].item() < 0.02


@pytest.mark.parametrize("lens", [{"division": -0.15}, {"wave": (0.2, 0.0)}, {"division": 0.2}])
def test_fitted_labels_describe_the_map(lens: dict[str, float]) -> None:
    """K = 4 guides of degree 5 fit a lens to half a pixel where doing nothing costs several."""
    labels, truth = truth_of(fixed_distortion(**lens))
    nothing = torch.tensor(STRAIGHT, dtype=torch.float32)[None]
    assert truth.errors(labels)[0].item() < 0.5
    assert truth.errors(nothing)[0].item() > 3


def test_a_pure_rotation_has_no_nonlinear_error() -> None:
    """Doing nothing about a rotation is wrong by many pixels, and by hardly any up to a homography."""
    _, truth = truth_of(fixed_distortion(degrees=8))
    overall, nonlinear = truth.errors(torch.tensor(STRAIGHT, dtype=torch.float32)[None])
    assert overall.item() > 8
    assert nonlinear.item() < 0.4


def test_true_guides_straighten_bent_chains() -> None:
    """The feedback of the true guides reports straight chains; that of straight guides reports the bend."""
    distortion = fixed_distortion(division=-0.18)
    labels, _ = truth_of(distortion)
    x = np.tile(np.linspace(-0.6, 0.6, 40), 3).astype(np.float32)
    y = np.repeat([-0.6, 0.3, 0.7], 40).astype(np.float32)
    bent_x, bent_y, _ = distortion.bend(x, y, np.zeros(120, np.int64))
    points = ChainPoints(bent_x, bent_y, np.ones(120, np.float32), np.arange(120) % 40 == 0, np.zeros(120, np.int64),
                         np.ones((1, 2), np.float32), np.full(1, 1 / 128, np.float32))  # fmt: skip
    features = torch.tensor(describe(points).features)
    feedback = Straightening()
    before = feedback(feedback.curves(torch.tensor(STRAIGHT, dtype=torch.float32).expand(3, -1)), features)
    after = feedback(feedback.curves(labels.expand(3, -1)), features)
    assert before[:, 12].abs().min() > 1.5
    assert after[:, 12].abs().max() < 0.7


def test_packed_and_padded_chains_give_the_same_guides() -> None:
    """Training packs, the exported network pads: same answer, whatever else is in the batch."""
    torch.manual_seed(0)
    network = LinesetNetwork(NetworkShape(features=FEATURES, chain_width=16, queries=4, global_width=24)).eval()
    for head in network.heads:
        torch.nn.init.normal_(head[2].weight, std=0.02)
    mask = torch.tensor([[1.0, 1, 1, 0], [1, 0, 0, 0]])
    features = torch.randn(2, 4, FEATURES) * mask[..., None]
    place = mask.flatten().nonzero()[:, 0]
    padded, _, _ = network(features, mask)
    packed, _ = network.estimates(features.reshape(8, -1)[place], Layout(mask, place, place // 4))
    assert padded.shape == (2, VALUES)
    torch.testing.assert_close(padded, packed[-1], atol=1e-5, rtol=1e-4)
