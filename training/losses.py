"""Losses of guides against a true map, in pixels of a 256 picture.

First-order error. At a true correspondence (x, y) <- (s, t) the guides leave the residuals y - R_t(x) and x - C_s(y),
linear in the node values; one Newton step with a detached Jacobian turns them into the displacement by which the
guides' map misses the source point. No iteration, no fold to fear.

Nonlinear part. The same displacement after its weighted projection on the eight tangents of target-side homographies,
transported into the source: what remains is what bends straight lines.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from training.labels import ANCHORS, NODES

PIXELS = 128.0
"""Pixels of a 256 picture per isotropic unit."""
OUTLIER_PX = 20.0


def _lagrange(nodes: list[float], at: Tensor) -> Tensor:
    """Lagrange basis over `nodes` at `at` (...) -> (..., len(nodes))."""
    columns = []
    for i, node in enumerate(nodes):
        product = torch.ones_like(at)
        for j, other in enumerate(nodes):
            if j != i:
                product = product * ((at - other) / (node - other))
        columns.append(product)
    return torch.stack(columns, -1)


_NODE_POWERS = np.linalg.inv(np.vander(NODES, increasing=True))
"""Monomial coefficients of the node basis: column n holds those of M_n."""


def _node_basis(at: Tensor) -> tuple[Tensor, Tensor]:
    """Node basis and its derivative at `at` (...): both (..., nodes)."""
    powers = torch.stack([at**k for k in range(len(NODES))], -1)
    slopes = torch.stack([k * at ** max(k - 1, 0) for k in range(len(NODES))], -1)
    matrix = torch.tensor(_NODE_POWERS, dtype=at.dtype, device=at.device)
    return powers @ matrix, slopes @ matrix


class Truth:
    """What the losses need of the true correspondences of a batch, computed once for all estimates.

    Args:
        source, target: (B, n, 2), isotropic frame. weight: (B, n). slopes: (B, n, 2, 2), d source / d target.
    """

    def __init__(self, source: Tensor, target: Tensor, weight: Tensor, slopes: Tensor) -> None:
        self._x, self._y = source.unbind(-1)
        self._share = weight / weight.sum(1, keepdim=True).clamp(min=1e-3)
        bounded = target.clamp(-1.8, 1.8)
        s, t = bounded.unbind(-1)
        self._over_rows, self._over_columns = _lagrange(ANCHORS.tolist(), t), _lagrange(ANCHORS.tolist(), s)
        self._at_x, self._slope_x = _node_basis(self._x)
        self._at_y, self._slope_y = _node_basis(self._y)
        self._tangents = _homography_tangents(s, t, slopes)
        weighted = self._tangents * torch.cat([self._share, self._share], 1)[..., None]
        normal = weighted.transpose(1, 2) @ self._tangents + 1e-5 * torch.eye(8, device=source.device)
        self._project = torch.linalg.solve(normal, weighted.transpose(1, 2))

    def misses(self, values: Tensor) -> Tensor:
        """Displacement (B, 2 n), px, x then y, by which guides with node values (B, 72) miss the source points."""
        half = values.shape[1] // 2
        rows = torch.bmm(self._over_rows, values[:, :half].reshape(len(values), len(ANCHORS), -1))
        columns = torch.bmm(self._over_columns, values[:, half:].reshape(len(values), len(ANCHORS), -1))
        miss_y = self._y - (rows * self._at_x).sum(-1)
        miss_x = self._x - (columns * self._at_y).sum(-1)
        with torch.no_grad():
            row_slope, column_slope = (rows * self._slope_x).sum(-1), (columns * self._slope_y).sum(-1)
            scale = PIXELS / (1 - row_slope * column_slope).clamp(min=0.3)
        return torch.cat([(miss_x + column_slope * miss_y) * scale, (row_slope * miss_x + miss_y) * scale], 1)

    def errors(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Mean first-order error of each sample, of all (B,) and of the nonlinear part (B,), px."""
        missed = self.misses(values)
        plane = (self._tangents @ (self._project @ missed[..., None]))[..., 0]
        return self._mean_length(missed), self._mean_length(missed - plane)

    def _mean_length(self, displacement: Tensor) -> Tensor:
        dx, dy = displacement.chunk(2, 1)
        return (torch.sqrt(dx * dx + dy * dy + 1e-4) * self._share).sum(1)


def _homography_tangents(s: Tensor, t: Tensor, slopes: Tensor) -> Tensor:
    """Source displacements (B, 2 n, 8) that the eight infinitesimal homographies of the target cause, x then y.

    They ought to go through the Jacobian of the estimated map, which lies between that of doing nothing and the true
    one (a pincushion's residual, measured after a real alignment, exceeds what the true Jacobian leaves by half).
    """
    slopes = (2 / 3) * torch.eye(2, device=slopes.device) + (1 / 3) * slopes
    zero, one = torch.zeros_like(s), torch.ones_like(s)
    in_s = torch.stack([one, zero, s, zero, t, zero, s * s, s * t], -1)
    in_t = torch.stack([zero, one, zero, s, zero, t, s * t, t * t], -1)
    dx = slopes[..., 0, 0, None] * in_s + slopes[..., 0, 1, None] * in_t
    dy = slopes[..., 1, 0, None] * in_s + slopes[..., 1, 1, None] * in_t
    return torch.cat([dx, dy], 1)


def tempered(error: Tensor) -> Tensor:
    """Errors past OUTLIER_PX count half: a hopeless sample must not drown the others."""
    return torch.where(error < OUTLIER_PX, error, OUTLIER_PX + (error - OUTLIER_PX) * 0.5)


def spread_loss(
    spreads: Tensor, values: Tensor, labels: Tensor, inverse_basis: Tensor, overall: Tensor, nonlinear: Tensor
) -> Tensor:
    """Negative log-likelihood of the predicted scales: Laplace for each coefficient, exponential for the errors.

    Labels are those of the first samples only. Everything but `spreads` is detached, so the scales learn from the
    guides and never against them.
    """
    known = len(labels)
    misfit = ((labels - values[:known].detach()) @ inverse_basis.t()).clamp(-30, 30).abs()
    log_scale = spreads[:known, :-2].clamp(-7, 4)
    coefficients = (misfit * torch.exp(-log_scale) + log_scale).mean()
    log_overall, log_nonlinear = spreads[:, -2].clamp(-4, 5), spreads[:, -1].clamp(-4, 5)
    means = overall.detach() * torch.exp(-log_overall) + log_overall
    means = means + nonlinear.detach() * torch.exp(-log_nonlinear) + log_nonlinear
    return coefficients + 0.3 * means.mean()
