"""What guides make of a chain: its points moved to the target, and how straight they lie there.

The network's refinement rounds are told this of their own estimate, so that they can correct it the way a plumb-line
method would. Isotropic frame; no gradient flows through it.
"""

# mypy: disallow-subclassing-any=False
# (types are also checked where torch is not installed, and its modules are Any)
from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor, nn

from training.labels import ANCHORS, NODES
from unbend_service.adapters.estimators.chain_features import LEGENDRE_DEGREE, REFERENCE, SAMPLES

FEEDBACK = SAMPLES + 8

_NEWTON_STEPS = 3
_FURTHEST = 2.5
_SHALLOWEST_SLOPE = 0.2


def _monomials(nodes: np.ndarray[tuple[int], np.dtype[np.float64]]) -> Tensor:
    """(n, n): row i holds the monomial coefficients of the i-th Lagrange polynomial over the nodes."""
    return torch.tensor(np.linalg.inv(np.vander(nodes, increasing=True)).T, dtype=torch.float32)


def _legendre_projection() -> Tensor:
    """(SAMPLES, degree + 1): offsets at evenly spaced parameters -> Legendre coefficients, least squares."""
    basis = np.polynomial.legendre.legvander(np.linspace(-1, 1, SAMPLES), LEGENDRE_DEGREE)
    return torch.tensor(np.linalg.pinv(basis).T, dtype=torch.float32)


class Straightening(nn.Module):
    """Feedback features of chains under guides."""

    by_node: Tensor
    by_anchor: Tensor
    legendre: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("by_node", _monomials(NODES), persistent=False)
        self.register_buffer("by_anchor", _monomials(ANCHORS), persistent=False)
        self.register_buffer("legendre", _legendre_projection(), persistent=False)

    def curves(self, values: Tensor) -> Tensor:
        """Node values (B, 72) as monomials in both variables, (B, 2 K (degree + 1)): for rows, then columns, the
        coefficient of target^k along^d at k (degree + 1) + d."""
        shape = (len(values), 2, len(ANCHORS), len(NODES))
        return (self.by_anchor.t() @ (values.view(shape) @ self.by_node)).flatten(1)

    def forward(self, curves: Tensor, features: Tensor) -> Tensor:
        """curves: (..., 72) of `curves`; features: (..., FEATURES) of chains, whose first 2 SAMPLES are the chain's
        points; leading shapes broadcast. Returns (..., FEEDBACK).

        Per chain, in reference pixels: the offsets of its straightened points across it; the second and third Legendre
        coefficients of these, corrected by what all points of the chain say beyond the samples; its direction.
        """
        x, y = features[..., :SAMPLES], features[..., SAMPLES : 2 * SAMPLES]
        s, t = self.straightened(curves, x, y)
        offset, cos, sin = _across(s, t)
        before, _, _ = _across(x, y)
        fitted = offset @ self.legendre
        missing = self._from_all_points(features) - (before @ self.legendre)[..., 2:4]
        bend = fitted[..., 2:4] + missing
        horizontal = (cos.abs() >= sin.abs()).float()
        deviation = torch.where(cos.abs() >= sin.abs(), sin / cos.clamp(min=0.5), -cos / sin.abs().clamp(min=0.5))
        direction = torch.cat([2 * cos * cos - 1, 2 * sin * cos, horizontal, _asinh(deviation * (90 / math.pi))], -1)
        return torch.cat([_asinh(offset / 0.5), _asinh(bend / 0.3), _asinh(bend / 0.05) / 3, direction], -1)

    def straightened(self, curves: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Target coordinates s, t (..., n) of source points x, y (..., n) under curves (..., 72)."""
        half = curves.shape[-1] // 2
        return self._target(curves[..., half:], y, x), self._target(curves[..., :half], x, y)

    def _target(self, monomials: Tensor, along: Tensor, across: Tensor) -> Tensor:
        """Target coordinate of points: solves sum_k sum_d m_kd t^k along^d = across for t by Newton's method.

        monomials: (..., K (degree + 1)). along, across: (..., SAMPLES).
        """
        curves = []
        for first in range(0, monomials.shape[-1], len(NODES)):
            curve = monomials[..., first + len(NODES) - 1, None]
            for degree in range(len(NODES) - 2, -1, -1):
                curve = curve * along + monomials[..., first + degree, None]
            curves.append(curve)
        target = across
        for _ in range(_NEWTON_STEPS):
            value, slope = curves[-1], torch.zeros_like(across)
            for curve in reversed(curves[:-1]):
                slope = slope * target + value
                value = value * target + curve
            step = ((value - across) / slope.clamp(min=_SHALLOWEST_SLOPE)).clamp(-0.6, 0.6)
            target = (target - step).clamp(-_FURTHEST, _FURTHEST)
        return target

    def _from_all_points(self, features: Tensor) -> Tensor:
        """Second and third Legendre coefficients that `chain_features` fitted to all points, undone from arcsinh."""
        first = 3 * SAMPLES
        scaled = features[..., first : first + 2].clamp(-5, 5)
        return (torch.exp(scaled) - torch.exp(-scaled)) * 0.15


def _across(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Offsets (..., SAMPLES) of points across the line through them, reference pixels; cos and sin (..., 1) of its
    direction, read as `chain_features` reads it."""
    steps = torch.linspace(-1, 1, SAMPLES, device=x.device)
    from_x, from_y = x - x.mean(-1, keepdim=True), y - y.mean(-1, keepdim=True)
    run, rise = (from_x * steps).sum(-1, keepdim=True), (from_y * steps).sum(-1, keepdim=True)
    length = torch.sqrt(run * run + rise * rise + 1e-12)
    cos, sin = run / length, rise / length
    flip = torch.where(torch.where(cos.abs() >= sin.abs(), cos, sin) < 0, -1.0, 1.0)
    cos, sin = cos * flip, sin * flip
    return (cos * from_y - sin * from_x) * REFERENCE, cos, sin


def _asinh(value: Tensor) -> Tensor:
    """arcsinh from operators that the ONNX exporter knows (sinh, above, is written out for the same reason)."""
    size = value.abs()
    return torch.sign(value) * torch.log(size + torch.sqrt(size * size + 1))
