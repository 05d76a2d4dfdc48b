"""From a checkpoint to what the service loads: an ONNX file and its machine-readable card, checked against torch."""

from __future__ import annotations

import hashlib
import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
import torch

from training.checkpoints import Checkpoint
from training.labels import ANCHORS, NODES
from training.lineset_network import LinesetNetwork
from unbend_service.adapters.estimators.chain_features import FEATURES
from unbend_service.domain.decision import TRUSTING, Caution

SEARCHED_LONG_SIDE_PX = 384
LOOKS = 2
UNCALIBRATED = (1.0, -1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""Weights of the confidence before it is calibrated: the displacement must outweigh the expected error."""
PARITY_TOLERANCE = 2e-4
"""Isotropic units (0.03 px at 256) by which ONNX Runtime may differ from torch."""


def export(
    checkpoint: Checkpoint,
    weights: Path,
    name: str = "lineset",
    confidence: tuple[float, ...] = UNCALIBRATED,
    looks: int = LOOKS,
    caution: Caution = TRUSTING,
) -> float:
    """Writes `weights` (.onnx) and the .json card beside it; returns the largest difference from torch.

    Raises:
        RuntimeError: ONNX Runtime computes something else than torch.
    """
    network = checkpoint.averaged_network()
    weights.parent.mkdir(parents=True, exist_ok=True)
    features, mask = _example(network)
    dynamic = {
        "features": {0: "pictures", 1: "chains"},
        "mask": {0: "pictures", 1: "chains"},
        "nodes": {0: "pictures"},
        "spreads": {0: "pictures"},
        "state": {0: "pictures"},
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the tracing exporter is deprecated; its successor needs onnxscript
        torch.onnx.export(
            network,
            (features, mask),
            str(weights),
            input_names=["features", "mask"],
            output_names=["nodes", "spreads", "state"],
            dynamic_axes=dynamic,
            opset_version=17,
            dynamo=False,
        )
    difference = parity(network, weights)
    if difference > PARITY_TOLERANCE:
        raise RuntimeError(f"ONNX Runtime differs from torch by {difference:.2e}.")
    write_card(weights, name, confidence, looks, caution)
    return difference


def parity(network: LinesetNetwork, weights: Path) -> float:
    """Largest absolute difference of the node values, torch against ONNX Runtime, for one to many chains."""
    session = ort.InferenceSession(str(weights), providers=["CPUExecutionProvider"])
    worst = 0.0
    for chains in (1, 17, 112):
        features, mask = _example(network, chains=chains, seed=chains)
        with torch.no_grad():
            expected = network(features, mask)[0].numpy()
        found = session.run(["nodes"], {"features": features.numpy(), "mask": mask.numpy()})[0]
        worst = max(worst, float(np.abs(found - expected).max()))
    return worst


def write_card(weights: Path, name: str, confidence: tuple[float, ...], looks: int, caution: Caution) -> None:
    """The .json beside the weights, as `unbend_service.adapters.estimators.cards` reads it."""
    card: dict[str, Any] = {
        "name": name,
        "kind": "lineset",
        "sha256": hashlib.sha256(weights.read_bytes()).hexdigest(),
        "min_confidence": caution.min_confidence,
        "full_confidence": caution.full_confidence,
        "doubtful_px": caution.doubtful_displacement * 256 / 2,
        "parameters": {
            "nodes": NODES.tolist(),
            "anchors": ANCHORS.tolist(),
            "searched_long_side_px": SEARCHED_LONG_SIDE_PX,
            "looks": looks,
            "confidence": list(confidence),
        },
    }
    weights.with_suffix(".json").write_text(json.dumps(card, indent=2) + "\n")


def _example(network: LinesetNetwork, chains: int = 24, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    features = torch.randn(2, chains, FEATURES, generator=generator)
    mask = (torch.rand(2, chains, generator=generator) < 0.8).float()
    mask[:, 0] = 1
    return features * network.feature_scale + network.feature_mean, mask
