"""The line-set network: from the descriptions of a picture's edge chains to guides and their uncertainty.

A set network in the manner of Set Transformer's pooling by attention (Lee et al. 2019): every chain is embedded by
the same small perceptron; rounds of softmax pooling with a few learned queries build up one global state, which is
fed back to the chains between rounds. Order and number of the chains do not matter.

After the founding rounds there is a first estimate. Each refinement round straightens the chains with the estimate so
far (see `straightening`), tells every chain what became of it, pools again, and adds a correction: a learned
Gauss-Newton step.

Output: 72 node values (see `labels`), isotropic frame, as coefficients of a fixed, scaled principal basis around the
straight guides; and, from a head whose gradient stops at its input, log scales of their errors.
"""

# mypy: disallow-subclassing-any=False
# (types are also checked where torch is not installed, and its modules are Any)
from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor, nn

from training.labels import STRAIGHT, VALUES
from training.straightening import FEEDBACK, Straightening

SPREADS = VALUES + 2
"""Log Laplace scale of each coefficient, log mean error of all, log mean error of the nonlinear part (px of 256)."""


@dataclass(frozen=True)
class NetworkShape:
    """Sizes."""

    features: int
    chain_width: int = 128
    queries: int = 16
    global_width: int = 256
    rounds: int = 3
    refinements: int = 0

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


class Layout:
    """Where the chains of a batch lie: padded to (B, N), or packed without padding, which is twice as fast.

    mask: (B, N) float, 1 where a chain is. place: (m,) index of each packed chain in the flattened mask, and picture:
    (m,) its index in the batch; None when padded.
    """

    def __init__(self, mask: Tensor, place: Tensor | None = None, picture: Tensor | None = None) -> None:
        self.mask, self.place, self.picture = mask, place, picture

    def padded(self, chains: Tensor) -> Tensor:
        """Per-chain rows as (B, N, width)."""
        if self.place is None:
            return chains
        size, slots = self.mask.shape
        full = chains.new_zeros(size * slots, chains.shape[1]).index_copy(0, self.place, chains)
        return full.view(size, slots, -1)

    def spread(self, pictures: Tensor) -> Tensor:
        """Per-picture rows (B, width), repeated for (or ready to broadcast over) their chains."""
        return pictures[:, None] if self.picture is None else pictures.index_select(0, self.picture)


class Pooling(nn.Module):
    """Chains -> global state."""

    def __init__(self, shape: NetworkShape, *, first: bool) -> None:
        super().__init__()
        width, state = shape.chain_width, shape.global_width
        self.norm = nn.LayerNorm(width)
        self.score = nn.Linear(width, shape.queries)
        self.merge = nn.Linear(shape.queries * width + (0 if first else state), state)
        self.merge_norm = nn.LayerNorm(state)

    def forward(self, chains: Tensor, state: Tensor | None, layout: Layout) -> tuple[Tensor, Tensor]:
        """The next state (B, state), and the normed chains."""
        normed = self.norm(chains).to(chains.dtype)
        scores = layout.padded(self.score(normed)).float()
        present = layout.mask[..., None]
        attention = torch.softmax(scores + (present - 1) * 30, 1) * present
        summary = torch.bmm(attention.to(normed.dtype).transpose(1, 2), layout.padded(normed)).flatten(1)
        if state is not None:
            summary = torch.cat([summary, state.to(summary.dtype)], 1)
        gain = torch.relu(self.merge_norm(self.merge(summary)))
        return (gain if state is None else state + gain), normed


class Feedback(nn.Module):
    """Global state (and, in refinements, what became of each chain) -> chains."""

    def __init__(self, shape: NetworkShape, *, refines: bool) -> None:
        super().__init__()
        self.state = nn.Linear(shape.global_width, shape.chain_width)
        self.inner = nn.Linear(shape.chain_width, shape.chain_width)
        self.outer = nn.Linear(shape.chain_width, shape.chain_width)
        self.straightened = nn.Linear(FEEDBACK, shape.chain_width) if refines else None

    def forward(self, chains: Tensor, normed: Tensor, state: Tensor, told: Tensor | None, layout: Layout) -> Tensor:
        hidden = self.inner(normed) + layout.spread(self.state(state))
        if self.straightened is not None and told is not None:
            hidden = hidden + self.straightened(told)
        return chains + self.outer(torch.relu(hidden))


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
        total = shape.rounds + shape.refinements
        self.poolings = nn.ModuleList([Pooling(shape, first=i == 0) for i in range(total)])
        self.feedbacks = nn.ModuleList([Feedback(shape, refines=i >= shape.rounds) for i in range(1, total)])
        self.straightening = Straightening()
        self.heads = nn.ModuleList([_perceptron(state, state, VALUES) for _ in range(1 + shape.refinements)])
        self.spread_head = _perceptron(state + VALUES + 1, 128, SPREADS)
        for correction in self.heads[1:]:
            nn.init.zeros_(correction[2].weight)

    def forward(self, features: Tensor, mask: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """features (B, N, F), mask (B, N) float, 1 where a chain is -> node values (B, 72), spreads (B, 74), and the
        global state (B, global_width)."""
        estimates, spreads, state = self.examined(features, Layout(mask))
        return estimates[-1], spreads, state

    def estimates(self, features: Tensor, layout: Layout) -> tuple[list[Tensor], Tensor]:
        """Node values (B, 72) after the founding rounds and after each refinement, and the spreads of the last.

        features: (B, N, F), or packed (m, F), as the layout says.
        """
        estimates, spreads, _ = self.examined(features, layout)
        return estimates, spreads

    def examined(self, features: Tensor, layout: Layout) -> tuple[list[Tensor], Tensor, Tensor]:
        """`estimates`, and the global state (B, global_width) that they come from."""
        chains = self._embedded(features)
        state: Tensor | None = None
        estimates: list[Tensor] = []
        normed = chains
        for index, pooling in enumerate(self.poolings):
            if state is not None:
                told = self._told(estimates[-1], features, layout) if estimates else None
                chains = self.feedbacks[index - 1](chains, normed, state, told, layout)
            state, normed = pooling(chains, state, layout)
            if index >= self.shape.rounds - 1:
                estimates.append(self._estimate(state, estimates))
        assert state is not None
        return estimates, self._spreads(state, estimates[-1], layout), state

    def _embedded(self, features: Tensor) -> Tensor:
        normed = ((features - self.feature_mean) / self.feature_scale).clamp(-8, 8)
        return torch.relu(self.embed_second(torch.relu(self.embed_first(normed))))

    def _told(self, values: Tensor, features: Tensor, layout: Layout) -> Tensor:
        with torch.no_grad(), torch.autocast(values.device.type, enabled=False):
            told: Tensor = self.straightening(layout.spread(self.straightening.curves(values)), features)
            return told

    def _estimate(self, state: Tensor, before: list[Tensor]) -> Tensor:
        with torch.autocast(state.device.type, enabled=False):
            change: Tensor = self.heads[len(before)](state.float()) @ self.basis.t()
            # Each refinement answers for its own correction; the estimate it started from has a loss of its own.
            return (before[-1].detach() if before else self.straight) + change

    def _spreads(self, state: Tensor, values: Tensor, layout: Layout) -> Tensor:
        with torch.autocast(state.device.type, enabled=False):
            chains = torch.log1p(layout.mask.sum(1, keepdim=True)) * 0.25
            known = [state.float().detach(), (values - self.straight).detach() * 4, chains]
            spreads: Tensor = self.spread_head(torch.cat(known, 1))
            return spreads


def _perceptron(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    last = nn.Linear(hidden, outputs)
    nn.init.normal_(last.weight, std=0.01)
    nn.init.zeros_(last.bias)
    return nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), last)
