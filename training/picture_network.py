"""The picture branch: what a picture shows besides its chains, and how far to believe either.

Where there are few edge chains the line-set network has little to go by, but a picture has other cues: short and weak
edges, the slant of trees and people. The branch looks at the whole picture with a small convolutional network over a
fixed front end (orientation harmonics of the gradient), and answers with guides of its own. A fusion head, which knows
the global state and the uncertainty of the line-set network too, then decides coefficient by coefficient whom to
follow, and what error to expect of the result. The line-set network itself stays as it is.

Frames as in `lineset_network`: 72 node values, isotropic; the view is the isotropic square (`views.view_of`).
"""

# mypy: disallow-subclassing-any=False
# (types are also checked where torch is not installed, and its modules are Any)
from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor, nn

from training.labels import STRAIGHT, VALUES
from training.lineset_network import SPREADS

ERRORS = 2
"""Log mean error of all, log mean error of the nonlinear part; px of 256."""


@dataclass(frozen=True)
class BranchShape:
    """Sizes; the first ones are those of the first network, whose weights the branch may begin with.

    depth: residual blocks at the coarsest scale.
    """

    harmonics: int = 6
    widths: tuple[int, int, int] = (32, 64, 96)
    narrow: int = 48
    summary: int = 8
    hidden: int = 256
    state: int = 256
    fusion: int = 320
    depth: int = 2

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


class OrientationFront(nn.Module):
    """Views (B, 1, s, s) -> (B, 2 + 2 harmonics, s / 4, s / 4): intensity, saturating edge strength w, and
    w cos(2 k theta), w sin(2 k theta) of the gradient's direction theta; zero outside the picture."""

    kernels: Tensor

    def __init__(self, harmonics: int) -> None:
        super().__init__()
        self.harmonics = harmonics
        smooth, slope = torch.tensor([3.0, 10.0, 3.0]) / 16, torch.tensor([-1.0, 0.0, 1.0]) / 2
        kernels = torch.stack([smooth[:, None] * slope, slope[:, None] * smooth])[:, None]
        self.register_buffer("kernels", kernels)

    def forward(self, view: Tensor, extent: Tensor) -> Tensor:
        """extent: (B, 2), half extents of the picture in the view."""
        centred = view - view.mean((1, 2, 3), keepdim=True)
        normed = centred / ((centred * centred).mean((1, 2, 3), keepdim=True).sqrt() + 0.03)
        gradient = nn.functional.conv2d(nn.functional.pad(normed, (1, 1, 1, 1), mode="replicate"), self.kernels)
        gx, gy = gradient[:, :1], gradient[:, 1:]
        energy = gx * gx + gy * gy + 1e-6
        cos, sin = (gx * gx - gy * gy) / energy, 2 * gx * gy / energy
        weight = energy / (energy + 0.02)
        maps = [normed, weight]
        c, s = cos, sin
        for _ in range(self.harmonics):
            maps += [weight * c, weight * s]
            c, s = c * cos - s * sin, s * cos + c * sin
        pooled = nn.functional.avg_pool2d(torch.cat(maps, 1), 4)
        return pooled * _inside(extent, pooled.shape[-1])


def _inside(extent: Tensor, cells: int) -> Tensor:
    """(B, 1, cells, cells): 1 where a cell lies inside the picture with both neighbours."""
    centres = (2 * torch.arange(cells, dtype=torch.float32, device=extent.device) + 1) / cells - 1
    across, down = extent[:, :1] - 2 / cells, extent[:, 1:] - 2 / cells
    # A picture that fills the view has no border of its own making.
    across, down = across + (extent[:, :1] > 0.999) * 0.1, down + (extent[:, 1:] > 0.999) * 0.1
    in_x, in_y = (centres.abs() <= across).float(), (centres.abs() <= down).float()
    return (in_y[:, :, None] * in_x[:, None, :])[:, None]


class _Residual(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, 1, 1)
        self.second = nn.Conv2d(width, width, 3, 1, 1)

    def forward(self, maps: Tensor) -> Tensor:
        return torch.relu(maps + self.second(torch.relu(self.first(maps))))


class PictureBranch(nn.Module):
    """See the module docstring."""

    pool: Tensor
    basis: Tensor
    inverse_basis: Tensor
    straight: Tensor

    def __init__(self, shape: BranchShape, basis: Tensor) -> None:
        super().__init__()
        self.shape = shape
        one, two, three = shape.widths
        self.front = OrientationFront(shape.harmonics)
        self.trunk = nn.Sequential(
            nn.Conv2d(2 + 2 * shape.harmonics, one, 3, 1, 1), nn.ReLU(), _Residual(one),
            nn.Conv2d(one, two, 3, 2, 1), nn.ReLU(), _Residual(two),
            nn.Conv2d(two, three, 3, 2, 1), nn.ReLU(), *(_Residual(three) for _ in range(shape.depth)),
            nn.Conv2d(three, shape.narrow, 1), nn.ReLU(),
        )  # fmt: skip
        self.register_buffer("pool", _pooling(12, shape.summary))
        self.summarise = nn.Linear(shape.narrow * shape.summary**2, shape.hidden)
        self.guides = nn.Linear(shape.hidden + 2, VALUES)
        told = shape.state + VALUES + SPREADS + shape.hidden + VALUES + 2
        self.fuse = nn.Sequential(
            nn.LayerNorm(told), nn.Linear(told, shape.fusion), nn.ReLU(),
            nn.Linear(shape.fusion, shape.fusion), nn.ReLU(),
        )  # fmt: skip
        self.gate = nn.Linear(shape.fusion, VALUES)
        self.change = nn.Linear(shape.fusion, VALUES)
        self.errors = nn.Sequential(nn.Linear(shape.fusion + 2 * VALUES, 96), nn.ReLU(), nn.Linear(96, ERRORS))
        for layer, bias in ((self.guides, 0.0), (self.gate, -2.0), (self.change, 0.0)):
            nn.init.normal_(layer.weight, std=0.002)
            nn.init.constant_(layer.bias, bias)
        self.register_buffer("basis", basis)
        self.register_buffer("inverse_basis", torch.linalg.inv(basis))
        self.register_buffer("straight", torch.tensor(STRAIGHT, dtype=torch.float32))

    def forward(
        self, view: Tensor, extent: Tensor, values: Tensor, spreads: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """view (B, 1, s, s), extent (B, 2), and what the line-set network said: values (B, 72), spreads (B, 74),
        state (B, state) -> fused values (B, 72), log errors (B, 2), the branch's own values (B, 72)."""
        maps = self.trunk(self.front(view, extent))
        pool = self.pool.to(maps.dtype)
        summary = (pool @ maps @ pool.t()).flatten(1)
        hidden = torch.relu(self.summarise(summary))
        with torch.autocast(view.device.type, enabled=False):
            hidden = hidden.float()
            own = self.straight + self.guides(torch.cat([hidden, 1 - extent], 1))
            said = (values - self.straight) @ self.inverse_basis.t()
            seen = (own - self.straight) @ self.inverse_basis.t()
            chains = [state * 0.2, said.clamp(-8, 8), spreads.clamp(-6, 5)]
            mixed = self.fuse(torch.cat([*chains, hidden, seen.detach().clamp(-8, 8), 1 - extent], 1))
            gate = torch.sigmoid(self.gate(mixed))
            fused = said + gate * (seen - said) + self.change(mixed)
            known = [mixed.detach(), fused.detach().clamp(-8, 8), (seen - said).detach().clamp(-8, 8)]
            return self.straight + fused @ self.basis.t(), self.errors(torch.cat(known, 1)), own


def _pooling(cells: int, bins: int) -> Tensor:
    """(bins, cells): means over the cells of each bin, as adaptive average pooling takes them."""
    matrix = torch.zeros(bins, cells)
    for b in range(bins):
        first, last = b * cells // bins, -(-(b + 1) * cells // bins)
        matrix[b, first:last] = 1 / (last - first)
    return matrix
