"""What the picture branch begins with: the weights of the first network, which is the same trunk with other guides."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import nn

from training.labels import ANCHORS, NODES
from training.picture_network import PictureBranch
from unbend_service.domain.guides import lagrange_basis

_FIRST_NODES = np.array([-0.9, -0.3, 0.3, 0.9])
"""Nodes and anchors of the first network, isotropic for a square picture."""
_OUTPUT_SCALE = 0.1 * 2
"""Its outputs are tenths in the unit frame."""
_AUXILIARY_WIDTH = (48, 64, 3, 3)


def begin_with_first(branch: PictureBranch, weights: Path) -> None:
    """Copies trunk, summary and guides from first.onnx, whose normalisations are folded into its convolutions."""
    tensors = {t.name: numpy_helper.to_array(t) for t in onnx.load(str(weights)).graph.initializer}
    folded = [name for name in tensors if name.startswith("onnx::Conv_")]
    pairs = [
        (tensors[weight], tensors[bias])
        for weight, bias in zip(folded[::2], folded[1::2], strict=True)
        if tensors[weight].shape != _AUXILIARY_WIDTH
    ]
    convolutions = [m for m in branch.trunk.modules() if isinstance(m, nn.Conv2d)]
    layers = [*convolutions, branch.summarise]
    pairs.append((tensors["h.1.weight"], tensors["h.1.bias"]))
    with torch.no_grad():
        for layer, (weight, bias) in zip(layers, pairs, strict=True):
            layer.weight.copy_(torch.from_numpy(weight.copy()))
            layer.bias.copy_(torch.from_numpy(bias.copy()))
        over = np.kron(lagrange_basis(_FIRST_NODES, ANCHORS), lagrange_basis(_FIRST_NODES, NODES))
        both = np.kron(np.eye(2), over) * _OUTPUT_SCALE
        hidden = branch.shape.hidden
        branch.guides.weight[:, :hidden].copy_(torch.from_numpy(both @ tensors["h.3.weight"]))
        branch.guides.bias.copy_(torch.from_numpy(both @ tensors["h.3.bias"]))
