"""The line-set network: from the descriptions of a picture's edge chains to guides and their uncertainty.

A set network in the manner of Set Transformer's pooling by attention (Lee et al. 2019): every chain is embedded by
the same small perceptron; rounds of softmax pooling with a few learned queries build up one global state, which is
fed back to the chains between rounds. Order and number of the chains do not matter.

Output: 48 node values (see `labels`), isotropic frame, as coefficients of a fixed, scaled principal basis around the
straight guides; and, from a head whose gradient stops at its input, log scales of their errors.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor, nn

from training.labels import STRAIGHT, VALUES

SPREADS = VALUES + 2
"""Log Laplace scale of each coefficient, log mean error of all, log mean error of the nonlinear part (px of 256)."""


@dataclass(frozen=True)
class NetworkShape:
    """Sizes; `founding_rounds` contribute from the start, later rounds grow from nothing (gates start at zero)."""

    features: int
    chain_width: int = 128
    queries: int = 16
    global_width: int = 256
    rounds: int = 5
    founding_rounds: int = 3

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


class PoolingRound(nn.Module):
    """Chains -> global state, and (unless it is the last round) global state -> chains."""

    def __init__(self, shape: NetworkShape, index: int) -> None:
        super().__init__()
        width, state = shape.chain_width, shape.global_width
        first, grown = index == 0, index >= shape.founding_rounds
        self.norm = nn.LayerNorm(width)
        self.score = nn.Linear(width, shape.queries)
        self.merge = nn.Linear(shape.queries * width + (0 if first else state), state)
        self.merge_norm = nn.LayerNorm(state)
        self.gate = nn.Parameter(torch.full((state,), 0.0 if grown else 1.0))
        self.is_last = index == shape.rounds - 1
        if not self.is_last:
            self.feedback = nn.Linear(state, width)
            self.inner = nn.Linear(width, width)
            self.outer = nn.Linear(width, width)
            if index >= shape.founding_rounds - 1:
                nn.init.zeros_(self.outer.weight)
                nn.init.zeros_(self.outer.bias)

    def pooled(self, chains: Tensor, scores: Tensor, mask: Tensor, state: Tensor | None) -> Tensor:
        """Next global state (B, state) from normed chains (B, N, width), scores (B, N, queries), mask (B, N)."""
        present = mask[..., None].to(scores.dtype)
        attention = torch.softmax(scores + (present - 1) * 30, 1) * present
        summary = torch.bmm(attention.to(chains.dtype).transpose(1, 2), chains).flatten(1)
        if state is not None:
            summary = torch.cat([summary, state.to(summary.dtype)], 1)
        gain = self.gate * torch.relu(self.merge_norm(self.merge(summary)))
        return gain if state is None else state + gain


class LinesetNetwork(nn.Module):
    """See the module docstring."""

    feature_mean: Tensor
    feature_scale: Tensor
    basis: Tensor
    straight: Tensor

    def __init__(self, shape: NetworkShape) -> None:
        super().__init__()
        self.shape = shape
        width, state = shape.chain_width, shape.global_width
        self.register_buffer("feature_mean", torch.zeros(shape.features))
        self.register_buffer("feature_scale", torch.ones(shape.features))
        self.register_buffer("basis", torch.eye(VALUES))
        self.register_buffer("straight", torch.tensor(STRAIGHT, dtype=torch.float32))
        self.embed_first = nn.Linear(shape.features, width)
        self.embed_second = nn.Linear(width, width)
        self.rounds = nn.ModuleList([PoolingRound(shape, i) for i in range(shape.rounds)])
        self.head = nn.Sequential(nn.Linear(state, state), nn.ReLU(), nn.Linear(state, VALUES))
        self.spread_head = nn.Sequential(nn.Linear(state + VALUES + 1, 128), nn.ReLU(), nn.Linear(128, SPREADS))
        for last in (self.head[2], self.spread_head[2]):
            assert isinstance(last, nn.Linear)
            nn.init.normal_(last.weight, std=0.01)
            nn.init.zeros_(last.bias)

    def forward(self, features: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """features (B, N, F), mask (B, N) float, 1 where a chain is -> node values (B, 48), spreads (B, 50)."""
        chains = self._embedded(features)
        state: Tensor | None = None
        for index, stage in enumerate(self._stages()):
            normed = stage.norm(chains)
            state = stage.pooled(normed, stage.score(normed), mask, state)
            if index < len(self.rounds) - 1:
                chains = chains + stage.outer(torch.relu(stage.inner(normed) + stage.feedback(state)[:, None]))
        assert state is not None
        return self._heads(state, mask)

    def packed(self, features: Tensor, place: Tensor, picture: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """The same for chains without padding, which is twice as fast: features (m, F), place (m,) their index in
        the flattened (B, N) mask, picture (m,) their index in the batch."""
        size, slots = mask.shape
        chains = self._embedded(features)
        state: Tensor | None = None
        for index, stage in enumerate(self._stages()):
            normed = stage.norm(chains).to(chains.dtype)
            scores = stage.score(normed)
            full = normed.new_zeros(size * slots, normed.shape[1]).index_copy(0, place, normed)
            full_scores = scores.new_zeros(size * slots, scores.shape[1]).index_copy(0, place, scores)
            state = stage.pooled(full.view(size, slots, -1), full_scores.view(size, slots, -1).float(), mask, state)
            if index < len(self.rounds) - 1:
                told = stage.feedback(state).index_select(0, picture)
                chains = chains + stage.outer(torch.relu(stage.inner(normed) + told))
        assert state is not None
        return self._heads(state, mask)

    def _stages(self) -> list[PoolingRound]:
        return [stage for stage in self.rounds if isinstance(stage, PoolingRound)]

    def _embedded(self, features: Tensor) -> Tensor:
        normed = ((features - self.feature_mean) / self.feature_scale).clamp(-8, 8)
        return torch.relu(self.embed_second(torch.relu(self.embed_first(normed))))

    def _heads(self, state: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        with torch.autocast("cpu", enabled=False):
            state = state.float()
            coefficients = self.head(state)
            chains = torch.log1p(mask.sum(1, keepdim=True)) * 0.25
            spreads = self.spread_head(torch.cat([state.detach(), coefficients.detach(), chains], 1))
            return self.straight + coefficients @ self.basis.t(), spreads
