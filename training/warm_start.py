"""Starting from the research network: 2.0 M parameters that spoke K = 4, degree 3, for square pictures only.

Its trunk is taken over as it is, new inputs enter with zero weights, and its 32 outputs are translated exactly (a
cubic is also a quintic), so the new network begins where the old one stopped.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from training.labels import ANCHORS, NODES
from training.lineset_network import LinesetNetwork
from unbend_service.domain.guides import lagrange_basis

_OLD_NODES = np.array([-0.9, -0.3, 0.3, 0.9])
_OLD_ROUNDS = 3


def inherit(network: LinesetNetwork, weights: Path) -> None:
    """Loads the research checkpoint into `network`, whose `basis` must already be set."""
    old: dict[str, Tensor] = torch.load(weights, weights_only=False)["ema"]
    new = network.state_dict()
    known = old["fm"].shape[0]
    new["feature_mean"][:known] = old["fm"]
    new["feature_scale"][:known] = old["fs"]
    new["embed_first.weight"].zero_()
    new["embed_first.weight"][:, :known] = old["e.0.weight"]
    names = {"embed_first.bias": "e.0.bias", "embed_second": "e.2", "heads.0.0": "h.0"}
    for index in range(_OLD_ROUNDS):
        names |= {
            f"poolings.{index}.norm": f"hn.{index}",
            f"poolings.{index}.score": f"sc.{index}",
            f"poolings.{index}.merge": f"g.{index}",
            f"poolings.{index}.merge_norm": f"gn.{index}",
        }
        if index < _OLD_ROUNDS - 1:
            names |= {
                f"feedbacks.{index}.state": f"fb.{index}",
                f"feedbacks.{index}.inner": f"up.{index}",
                f"feedbacks.{index}.outer": f"up2.{index}",
            }
    for new_name, old_name in names.items():
        for suffix in ("", ".weight", ".bias"):
            if new_name + suffix in new and old_name + suffix in old:
                new[new_name + suffix].copy_(old[old_name + suffix])
    translate = _translation(network.basis, old["basis"])
    new["heads.0.2.weight"].copy_(translate @ old["h.2.weight"])
    new["heads.0.2.bias"].copy_(translate @ old["h.2.bias"])
    network.load_state_dict(new)


def _translation(basis: Tensor, old_basis: Tensor) -> Tensor:
    """(48, 32): coefficients in the new basis of what the old coefficients said; old node values lived in [0, 1]."""
    resample = lagrange_basis(_OLD_NODES, NODES)
    values = torch.tensor(np.kron(np.eye(2 * len(ANCHORS)), resample), dtype=torch.float64) * 2
    return (torch.linalg.inv(basis.double()) @ values @ old_basis.double()).float()
