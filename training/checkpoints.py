"""Checkpoints: everything a run needs to go on as if it had never stopped."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from training.lineset_network import LinesetNetwork, NetworkShape


@dataclass
class Checkpoint:
    """A run at one moment. `average` holds the exponential moving average of the parameters, which is what ships."""

    shape: NetworkShape
    model: dict[str, Tensor]
    average: dict[str, Tensor]
    optimiser: dict[str, Any]
    generator: dict[str, Any]
    step: int
    samples: int
    seconds: float
    notes: dict[str, Any]

    def save(self, path: Path) -> None:
        """Written whole or not at all."""
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_suffix(".tmp")
        torch.save({**vars(self), "shape": self.shape.to_dict()}, temporary)
        os.replace(temporary, path)

    @staticmethod
    def load(path: Path) -> Checkpoint:
        # Our own files hold the numpy generator's state, which is plain Python but not plain tensors.
        content = torch.load(path, weights_only=False)
        return Checkpoint(**{**content, "shape": NetworkShape(**content["shape"])})

    def averaged_network(self) -> LinesetNetwork:
        """The network with averaged parameters, ready to be asked."""
        network = LinesetNetwork(self.shape)
        network.load_state_dict(self.average)
        network.eval()
        return network

    def restored_generator(self) -> np.random.Generator:
        generator = np.random.default_rng()
        generator.bit_generator.state = self.generator
        return generator
