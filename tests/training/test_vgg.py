"""The paper's network, small parts of it on drawn pictures: data, start, training that goes on, export."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
import torch
from onnx import helper, numpy_helper

from training.annotations import Annotation
from training.vgg_data import ANCHORS, annotated_sample, coefficients, distorted_sample, rotated_guides
from training.vgg_export import with_small_weights
from training.vgg_network import COEFFICIENTS, SIDE_PX, Head, RescaledGuides
from training.vgg_regression import regress
from unbend_service.domain.guides import Guides
from unbend_service.domain.maps import target_lattice

pytestmark = pytest.mark.training


def test_a_sample_is_a_grey_square_and_sixteen_numbers() -> None:
    """Reproducible from its seed."""
    photograph = np.random.default_rng(0).integers(0, 256, (300, 400, 3), dtype=np.uint8)
    one, other = (distorted_sample(photograph, np.random.default_rng(4)) for _ in range(2))
    assert one[0].shape == (SIDE_PX, SIDE_PX)
    assert one[1].shape == (COEFFICIENTS,)
    np.testing.assert_array_equal(one[0], other[0])
    np.testing.assert_array_equal(one[1], other[1])


def test_annotations_turn_with_their_picture(tmp_path: Path) -> None:
    """The guides of a picture turned by ten degrees are straight ones, turned by ten degrees about its centre."""
    straight = Guides.straight(ANCHORS, 3)
    target = target_lattice(5, 5, 0.5)
    angle, half = np.radians(10.0), np.array([200.0, 150.0])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    expected = (target * half) @ turn.T / half
    np.testing.assert_allclose(rotated_guides(straight, 200, 150, 10.0)(target), expected, atol=1e-3)
    cv2.imwrite(str(tmp_path / "a.png"), np.full((150, 200), 80, np.uint8))
    picture, labels = annotated_sample(
        Annotation(tmp_path / "a.png", 200, 150, straight, 0.0), np.random.default_rng(1)
    )
    assert picture.shape == (SIDE_PX, SIDE_PX)
    assert np.abs(labels - coefficients(straight)).max() > 0.005


def test_rescaled_coefficients_come_back() -> None:
    """0 and 1 are the ends of each coefficient's own range."""
    low, high = np.linspace(-1, 0, 16), np.linspace(0.5, 2, 16)
    rescaling = RescaledGuides(low, high)
    assert torch.allclose(rescaling.rescaled(torch.tensor(high, dtype=torch.float32)), torch.ones(16))
    values = torch.randn(3, 16)
    assert torch.allclose(rescaling(rescaling.rescaled(values)), values, atol=1e-5)


def test_the_head_starts_as_the_regression() -> None:
    """Neither the LeakyReLU nor the normalisation changes what was regressed within 0..1."""
    rng = np.random.default_rng(2)
    features = rng.random((60, 512 * 49), dtype=np.float32)
    wanted = 0.5 + 0.02 * (features[:, :16] - 0.5).astype(np.float64)
    start = regress(features, wanted)
    answers = torch.tensor(features @ start.weight.T + start.bias)
    head = Head().eval()
    head.start_from(torch.tensor(start.weight), torch.tensor(start.bias), answers.std(0), answers.mean(0))
    with torch.no_grad():
        found = head.normalisation(head.activation(head.nodes(torch.tensor(features))))
    assert torch.allclose(found, answers, atol=1e-4)
    assert float(((answers.numpy() - wanted) ** 2).mean()) < float(wanted.var())


def test_small_weights_compute_nearly_the_same() -> None:
    """Eight bits and a scale per channel; a quarter of the size."""
    import onnxruntime as ort

    kernel = np.random.default_rng(3).normal(size=(32, 16, 3, 3)).astype(np.float32)
    node = helper.make_node("Conv", ["x", "kernel"], ["y"], pads=[1, 1, 1, 1])
    graph = helper.make_graph(
        [node],
        "one convolution",
        [helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1, 16, 8, 8])],
        [helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, [1, 32, 8, 8])],
        [numpy_helper.from_array(kernel, "kernel")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    x = np.random.default_rng(4).normal(size=(1, 16, 8, 8)).astype(np.float32)

    def run(content: bytes) -> np.ndarray:
        return np.asarray(ort.InferenceSession(content, providers=["CPUExecutionProvider"]).run(None, {"x": x})[0])

    before = model.SerializeToString()
    after = with_small_weights(model).SerializeToString()
    assert len(after) < 0.4 * len(before)
    assert np.abs(run(before) - run(after)).mean() < 0.01 * np.abs(run(before)).mean() + 0.05
