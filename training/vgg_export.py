"""The paper's network as the service loads it: ONNX, the convolutions' weights in eight bits, and the card beside it.

In float32 the weights take 60 MB. Each output channel of a convolution gets a scale of its own and int8 weights, which
the graph turns back into float32 where they are used; activations stay float32. Both graphs are compared: the float32
one with torch, and the small one with the float32 one, in pixels of the guides.
"""

from __future__ import annotations

import hashlib
import json
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import onnxruntime as ort
import torch
from onnx import helper, numpy_helper

from training.vgg_data import ANCHORS, DEGREE
from training.vgg_network import SIDE_PX, Vgg16Guides

PARITY_TOLERANCE = 1e-3
"""Centred units (0.13 px at 256) by which a coefficient of the float32 graph may differ from torch."""
_SMALLEST_QUANTISED = 4096
_LEVELS = 127


@dataclass(frozen=True)
class Exported:
    """parity: largest difference of a coefficient, float32 graph against torch. quantisation_px: mean distance that
    eight-bit weights move the guides, px at 256. size_mb: of the file."""

    parity: float
    quantisation_px: float
    size_mb: float


def export(network: Vgg16Guides, weights: Path, pictures: npt.NDArray[np.uint8], name: str = "vgg16") -> Exported:
    """Writes `weights` (.onnx) and its card; `pictures` are grey (n, 224, 224) that both graphs are compared on.

    Raises:
        RuntimeError: ONNX Runtime computes something else than torch.
    """
    network.eval()
    weights.parent.mkdir(parents=True, exist_ok=True)
    full = weights.with_suffix(".float32.onnx")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the tracing exporter is deprecated; its successor needs onnxscript
        torch.onnx.export(
            network,
            (torch.zeros(2, 1, SIDE_PX, SIDE_PX),),
            str(full),
            input_names=["image"],
            output_names=["coefficients"],
            dynamic_axes={"image": {0: "pictures"}, "coefficients": {0: "pictures"}},
            opset_version=17,
            dynamo=False,
        )
    batch = pictures[:, None].astype(np.float32)
    with torch.no_grad():
        expected = network(torch.tensor(batch)).numpy()
    exact = _run(full, batch)
    parity = float(np.abs(exact - expected).max())
    if parity > PARITY_TOLERANCE:
        raise RuntimeError(f"ONNX Runtime differs from torch by {parity:.2e}.")
    onnx.save(with_small_weights(onnx.load(str(full))), str(weights))
    full.unlink()
    moved = guide_distance_px(_run(weights, batch), exact)
    write_card(weights, name)
    return Exported(parity, moved, weights.stat().st_size / 1e6)


def with_small_weights(model: Any) -> Any:
    """The model with the kernels of its convolutions as int8 and a scale per output channel."""
    graph = model.graph
    kernels = {node.input[1] for node in graph.node if node.op_type == "Conv"}
    nodes = []
    for tensor in list(graph.initializer):
        if tensor.name not in kernels:
            continue
        values = numpy_helper.to_array(tensor)
        if values.size < _SMALLEST_QUANTISED:
            continue
        scales = np.maximum(np.abs(values).max((1, 2, 3)) / _LEVELS, 1e-12).astype(np.float32)
        small = np.rint(values / scales[:, None, None, None]).astype(np.int8)
        graph.initializer.remove(tensor)
        parts = {"int8": small, "scale": scales, "zero": np.zeros(len(scales), np.int8)}
        for part, array in parts.items():
            graph.initializer.append(numpy_helper.from_array(array, f"{tensor.name}.{part}"))
        inputs = [f"{tensor.name}.{part}" for part in parts]
        nodes.append(helper.make_node("DequantizeLinear", inputs, [tensor.name], axis=0))
    for node in reversed(nodes):
        graph.node.insert(0, node)
    onnx.checker.check_model(model)
    return model


def guide_distance_px(found: npt.NDArray[np.float32], wanted: npt.NDArray[np.float32]) -> float:
    """Mean distance of the curves of coefficients (n, 16), px at 256."""
    along = np.vander(np.linspace(-0.9, 0.9, 13), DEGREE + 1, increasing=True)
    return float(np.abs((found - wanted).reshape(-1, DEGREE + 1) @ along.T).mean() * 128)


def write_card(weights: Path, name: str) -> None:
    """The .json beside the weights, as `unbend_service.adapters.estimators.cards` reads it."""
    card = {
        "name": name,
        "kind": "coefficients",
        "sha256": hashlib.sha256(weights.read_bytes()).hexdigest(),
        "parameters": {"anchors": list(ANCHORS), "degree": DEGREE},
    }
    weights.with_suffix(".json").write_text(json.dumps(card, indent=2) + "\n")


def _run(weights: Path, batch: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    session = ort.InferenceSession(str(weights), providers=["CPUExecutionProvider"])
    return np.asarray(session.run(["coefficients"], {"image": batch})[0], np.float32)
