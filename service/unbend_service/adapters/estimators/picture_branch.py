"""The picture branch of the line-set estimator: what a picture shows besides its edge chains.

Where there are few chains the line-set network knows little. The branch looks at the whole picture, and decides,
knowing what the line-set network said and how sure it was, whom to follow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from unbend_service.adapters.estimators.cards import ModelCard, companion
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


class PictureBranch:
    """A network beside the line-set network; ``card.parameters["branch"]`` holds its file name and SHA-256.

    Raises:
        ModelUnavailable: weights that cannot be loaded, or other ones than the card says.
    """

    def __init__(self, card: ModelCard, threads: int) -> None:
        self._session = open_session(companion(card, "branch"), threads)
        shape = self._session.get_inputs()[0].shape
        if list(shape[1:]) != [1, VIEW_PX, VIEW_PX]:
            raise ModelUnavailable(f"The branch of {card.name!r} takes {shape}.", setting="model")

    def fused(self, grey: Bytes, chains: ChainsAnswer) -> tuple[Float32, Float32]:
        """Node values (2, values) of a picture and of its mirror image, and the log expected errors (2, 2) of each:
        of everything, and of the nonlinear part; px of a picture whose long side has 256.

        Args:
            grey: (height, width) uint8.
            chains: what the line-set network said of the same two.
        """
        view = view_of(grey)
        long_side = max(grey.shape)
        extent = np.array([[grey.shape[1], grey.shape[0]]], np.float32) / np.float32(long_side)
        nodes, errors = self._session.run(
            ["nodes", "errors"],
            {
                "view": np.ascontiguousarray(np.stack([view, view[:, ::-1]])[:, None]),
                "extent": np.repeat(extent, 2, axis=0),
                "chain_nodes": chains.nodes,
                "chain_spreads": chains.spreads,
                "chain_state": chains.state,
            },
        )
        return np.asarray(nodes), np.asarray(errors)
