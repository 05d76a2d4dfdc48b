"""From a checkpoint of the picture branch to the second weight file of a model, checked against torch."""

from __future__ import annotations

import hashlib
import json
import warnings
from pathlib import Path

import numpy as np
import onnxruntime as ort
import torch
from torch import Tensor, nn

from training.export import PARITY_TOLERANCE
from training.labels import VALUES
from training.lineset_network import SPREADS
from training.picture_loop import BranchCheckpoint
from training.picture_network import PictureBranch
from unbend_service.adapters.estimators.views import VIEW_PX

# mypy: disallow-subclassing-any=False
# (types are also checked where torch is not installed, and its modules are Any)


class _Answer(nn.Module):
    """The branch without its own guides, which only training wants."""

    def __init__(self, branch: PictureBranch) -> None:
        super().__init__()
        self.branch = branch

    def forward(self, *told: Tensor) -> tuple[Tensor, Tensor]:
        nodes, errors, _ = self.branch(*told)
        return nodes, errors


def export_branch(checkpoint: BranchCheckpoint, model: Path) -> float:
    """Writes `<model stem>-picture.onnx` beside the weights `model` and names it in their card; returns the largest
    difference from torch.

    Raises:
        RuntimeError: ONNX Runtime computes something else than torch.
    """
    answer = _Answer(checkpoint.averaged_branch()).eval()
    weights = model.with_name(f"{model.stem}-picture.onnx")
    inputs = ["view", "extent", "chain_nodes", "chain_spreads", "chain_state"]
    example = _example(checkpoint)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the tracing exporter is deprecated; its successor needs onnxscript
        torch.onnx.export(
            answer,
            example,
            str(weights),
            input_names=inputs,
            output_names=["nodes", "errors"],
            dynamic_axes={name: {0: "pictures"} for name in [*inputs, "nodes", "errors"]},
            opset_version=17,
            dynamo=False,
        )
    session = ort.InferenceSession(str(weights), providers=["CPUExecutionProvider"])
    with torch.no_grad():
        expected = answer(*example)[0].numpy()
    found = session.run(["nodes"], {name: a.numpy() for name, a in zip(inputs, example, strict=True)})[0]
    difference = float(np.abs(np.asarray(found) - expected).max())
    if difference > PARITY_TOLERANCE:
        raise RuntimeError(f"ONNX Runtime differs from torch by {difference:.2e}.")
    card = json.loads(model.with_suffix(".json").read_text())
    sha256 = hashlib.sha256(weights.read_bytes()).hexdigest()
    card["parameters"]["branch"] = {"weights": weights.name, "sha256": sha256}
    model.with_suffix(".json").write_text(json.dumps(card, indent=2) + "\n")
    return difference


def _example(checkpoint: BranchCheckpoint) -> tuple[Tensor, ...]:
    generator = torch.Generator().manual_seed(0)
    straight = checkpoint.average["straight"]
    return (
        torch.rand(2, 1, VIEW_PX, VIEW_PX, generator=generator),
        torch.tensor([[1.0, 0.75], [0.6, 1.0]]),
        straight + 0.05 * torch.randn(2, VALUES, generator=generator),
        torch.randn(2, SPREADS, generator=generator),
        torch.rand(2, checkpoint.shape.state, generator=generator),
    )
