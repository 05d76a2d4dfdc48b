"""The picture branch of the line-set estimator: what a picture shows besides its edge chains.

Where there are few chains the line-set network knows little. The branch looks at the whole picture, and decides,
knowing what the line-set network said and how sure it was, whom to follow.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from unbend_service.adapters.cores import usable_cores
from unbend_service.adapters.estimators.cards import ModelCard, companion
from unbend_service.adapters.estimators.graph_parts import parted
from unbend_service.adapters.estimators.sessions import open_session
from unbend_service.adapters.estimators.views import VIEW_PX, view_of
from unbend_service.application.ports import Bytes
from unbend_service.domain.errors import ModelUnavailable

Float32 = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class ChainsAnswer:
    """What the line-set network says of n pictures.

    Attributes:
        nodes: (n, values) float32, node values. spreads: (n, values + 2) float32, log scales.
        state: (n, width) float32, its global state.
    """

    nodes: Float32
    spreads: Float32
    state: Float32


#: Takes what the line-set network says, waits, and gives node values (2, values) of picture and mirror image, and the
#: log expected errors (2, 2): of everything, and of the nonlinear part; px of a picture whose long side has 256.
Fused = Callable[[ChainsAnswer], tuple[Float32, Float32]]

_CHAINS_ANSWER = ("chain_nodes", "chain_spreads", "chain_state")


class PictureBranch:
    """A network beside the line-set network; ``card.parameters["branch"]`` holds its file name and SHA-256.

    Nearly all of it looks at the picture alone. With two threads or more that is done in a thread of its own, while the
    chains are traced.

    Args:
        threads: of one estimate, the caller's among them; 0: as many as usable cores.

    Raises:
        ModelUnavailable: weights that cannot be loaded, or other ones than the card says.
    """

    def __init__(self, card: ModelCard, threads: int) -> None:
        weights = companion(card, "branch")
        threads = threads or usable_cores()
        parts = parted(weights.read_bytes(), _CHAINS_ANSWER) if threads > 1 else None
        self._between: tuple[str, ...] = ()
        self._workers: ThreadPoolExecutor | None = None
        if parts is not None:
            self._between = parts.between
            self._workers = ThreadPoolExecutor(usable_cores(), "unbend-view")
            self._early = open_session(weights, threads - 1, parts.early)
        self._session = open_session(weights, threads, parts.late if parts else None)
        view = next((one for one in (self._early if parts else self._session).get_inputs() if one.name == "view"), None)
        if view is None or list(view.shape[1:]) != [1, VIEW_PX, VIEW_PX]:
            raise ModelUnavailable(
                f"The branch of {card.name!r} takes no picture of {VIEW_PX} pixels.", setting="model"
            )
        self._inputs = [one.name for one in self._session.get_inputs()]

    def look(self, grey: Bytes) -> Fused:
        """Begins to look at a picture, (height, width) uint8, and its mirror image.

        Returns:
            What is to be told what the line-set network says of the same two.
        """
        seen = self._workers.submit(self._begun, grey) if self._workers else None

        def fused(chains: ChainsAnswer) -> tuple[Float32, Float32]:
            told = {"chain_nodes": chains.nodes, "chain_spreads": chains.spreads, "chain_state": chains.state}
            given = {**(seen.result() if seen else _inputs(grey)), **told}
            nodes, errors = self._session.run(["nodes", "errors"], {name: given[name] for name in self._inputs})
            return np.asarray(nodes), np.asarray(errors)

        return fused

    def _begun(self, grey: Bytes) -> dict[str, Float32]:
        inputs = _inputs(grey)
        told = {one.name: inputs[one.name] for one in self._early.get_inputs()}
        return inputs | dict(zip(self._between, self._early.run(self._between, told), strict=True))


def _inputs(grey: Bytes) -> dict[str, Float32]:
    view = view_of(grey)
    extent = np.array([[grey.shape[1], grey.shape[0]]], np.float32) / np.float32(max(grey.shape))
    return {
        "view": np.ascontiguousarray(np.stack([view, view[:, ::-1]])[:, None]),
        "extent": np.repeat(extent, 2, axis=0),
    }
