"""Losses of guides against a true map, in pixels of a 256 picture.

First-order error. At a true correspondence (x, y) <- (s, t) the guides leave the residuals y - R_t(x) and x - C_s(y),
linear in the node values; one Newton step with a detached Jacobian turns them into the displacement by which the
guides' map misses the source point. No iteration, no fold to fear.

Nonlinear part. The same displacement after its weighted projection on the eight tangents of target-side homographies,
transported into the source by the true map's Jacobian: what remains is what bends straight lines.
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
    matrix = torch.tensor(_NODE_POWERS, dtype=at.dtype)
    return powers @ matrix, slopes @ matrix


def misses(values: Tensor, source: Tensor, target: Tensor) -> Tensor:
    """Displacement (B, n, 2), px, by which guides with node values (B, 48) miss the source points (B, n, 2) of the
    targets (B, n, 2)."""
    size = len(values)
    half = values.shape[1] // 2
    rows, columns = values[:, :half].view(size, len(ANCHORS), -1), values[:, half:].view(size, len(ANCHORS), -1)
    x, y = source.unbind(-1)
    s, t = target.clamp(-1.8, 1.8).unbind(-1)
    anchors = ANCHORS.tolist()
    with torch.no_grad():
        over_rows, over_columns = _lagrange(anchors, t), _lagrange(anchors, s)
        at_x, slope_x = _node_basis(x)
        at_y, slope_y = _node_basis(y)
    row, column = torch.bmm(over_rows, rows), torch.bmm(over_columns, columns)
    miss_y = y - (row * at_x).sum(-1)
    miss_x = x - (column * at_y).sum(-1)
    with torch.no_grad():
        row_slope, column_slope = (row * slope_x).sum(-1), (column * slope_y).sum(-1)
        determinant = (1 - row_slope * column_slope).clamp(min=0.3)
    dx = (miss_x + column_slope * miss_y) / determinant
    dy = (row_slope * miss_x + miss_y) / determinant
    return torch.stack([dx, dy], -1) * PIXELS


def homography_tangents(target: Tensor, slopes: Tensor) -> Tensor:
    """Source displacements (B, 2 n, 8) that the eight infinitesimal homographies of the target cause, x then y."""
    s, t = target.clamp(-1.8, 1.8).unbind(-1)
    zero, one = torch.zeros_like(s), torch.ones_like(s)
    in_s = torch.stack([one, zero, s, zero, t, zero, s * s, s * t], -1)
    in_t = torch.stack([zero, one, zero, s, zero, t, s * t, t * t], -1)
    dx = slopes[..., 0, 0, None] * in_s + slopes[..., 0, 1, None] * in_t
    dy = slopes[..., 1, 0, None] * in_s + slopes[..., 1, 1, None] * in_t
    return torch.cat([dx, dy], 1)


def errors(values: Tensor, source: Tensor, target: Tensor, weight: Tensor, slopes: Tensor) -> tuple[Tensor, Tensor]:
    """Mean first-order error of each sample, of all (B,) and of the nonlinear part (B,), px."""
    missed = misses(values, source, target)
    share = weight / weight.sum(1, keepdim=True).clamp(min=1e-3)
    overall = (torch.sqrt((missed**2).sum(-1) + 1e-4) * share).sum(1)
    with torch.no_grad():
        tangents = homography_tangents(target, slopes)
        weighted = tangents * torch.cat([share, share], 1)[..., None]
        normal = weighted.transpose(1, 2) @ tangents + 1e-5 * torch.eye(8)
        project = torch.linalg.solve(normal, weighted.transpose(1, 2))
    flat = torch.cat([missed[..., 0], missed[..., 1]], 1)
    rest = flat - (tangents @ (project @ flat[..., None]))[..., 0]
    count = source.shape[1]
    nonlinear = (torch.sqrt(rest[:, :count] ** 2 + rest[:, count:] ** 2 + 1e-4) * share).sum(1)
    return overall, nonlinear


def tempered(error: Tensor) -> Tensor:
    """Errors past OUTLIER_PX count half: a hopeless sample must not drown the others."""
    return torch.where(error < OUTLIER_PX, error, OUTLIER_PX + (error - OUTLIER_PX) * 0.5)


def spread_loss(
    spreads: Tensor, values: Tensor, labels: Tensor, inverse_basis: Tensor, overall: Tensor, nonlinear: Tensor
) -> Tensor:
    """Negative log-likelihood of the predicted scales: Laplace for each coefficient, exponential for the errors.

    Everything but `spreads` is detached, so the scales learn from the guides and never against them.
    """
    misfit = ((labels - values.detach()) @ inverse_basis.t()).clamp(-30, 30).abs()
    log_scale = spreads[:, :-2].clamp(-7, 4)
    coefficients = (misfit * torch.exp(-log_scale) + log_scale).mean()
    log_overall, log_nonlinear = spreads[:, -2].clamp(-4, 5), spreads[:, -1].clamp(-4, 5)
    means = overall.detach() * torch.exp(-log_overall) + log_overall
    means = means + nonlinear.detach() * torch.exp(-log_nonlinear) + log_nonlinear
    return coefficients + 0.3 * means.mean()
