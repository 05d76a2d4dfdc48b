"""The picture branch of the line-set estimator: what a picture shows besides its edge chains.

Where there are few chains the line-set network knows little. The branch looks at the whole picture, and decides,
knowing what the line-set network said and how sure it was, whom to follow.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from onnxruntime import InferenceSession

from unbend_service.adapters.cores import usable_cores
from unbend_service.adapters.estimators.cards import ModelCard, companion
from unbend_service.adapters.estimators.graph_parts import headed, parted
from unbend_service.adapters.estimators.sessions import open_session
from unbend_service.adapters.estimators.views import VIEW_PX, mirrored_maps, view_of
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

#: What the names of the front end's nodes begin with, by the modules that `training.picture_export` traces.
_FRONT = "/branch/front/"
_CHAINS_ANSWER = ("chain_nodes", "chain_spreads", "chain_state")


class PictureBranch:
    """A network beside the line-set network; ``card.parameters["branch"]`` holds its file name and SHA-256.

    Nearly all of it looks at the picture alone. With two threads or more that is done in a thread of its own, while the
    chains are traced. Its front end learns nothing, and what it makes of the mirror image follows from what it makes
    of the picture, so it looks at one of them only.

    Args:
        threads: of one estimate, the caller's among them; 0: as many as usable cores.

    Raises:
        ModelUnavailable: weights that cannot be loaded, or other ones than the card says.
    """

    def __init__(self, card: ModelCard, threads: int) -> None:
        weights = companion(card, "branch")
        threads = threads or usable_cores()
        parts = parted(weights.read_bytes(), _CHAINS_ANSWER)
        heads = headed(parts.early, _FRONT) if parts else None
        if parts is None or heads is None or len(heads.between) != 1:
            raise ModelUnavailable(f"The branch of {card.name!r} is none that training exports.", setting="model")
        self._workers = ThreadPoolExecutor(usable_cores(), "unbend-view") if threads > 1 else None
        self._front = open_session(weights, max(1, threads - 1), heads.early)
        self._trunk = open_session(weights, max(1, threads - 1), heads.late)
        self._fusion = open_session(weights, threads, parts.late)
        view = next((one for one in self._front.get_inputs() if one.name == "view"), None)
        if view is None or list(view.shape[1:]) != [1, VIEW_PX, VIEW_PX]:
            raise ModelUnavailable(
                f"The branch of {card.name!r} takes no picture of {VIEW_PX} pixels.", setting="model"
            )
        self._maps, self._between = heads.between[0], parts.between

    def look(self, grey: Bytes) -> Fused:
        """Begins to look at a picture, (height, width) uint8, and its mirror image.

        Returns:
            What is to be told what the line-set network says of the same two.
        """
        seen = self._workers.submit(self._seen, grey) if self._workers else None

        def fused(chains: ChainsAnswer) -> tuple[Float32, Float32]:
            told = {"chain_nodes": chains.nodes, "chain_spreads": chains.spreads, "chain_state": chains.state}
            given = told | (seen.result() if seen else self._seen(grey))
            nodes, errors = self._fusion.run(["nodes", "errors"], _asked(self._fusion, given))
            return np.asarray(nodes), np.asarray(errors)

        return fused

    def _seen(self, grey: Bytes) -> dict[str, Float32]:
        """What the picture and its mirror image say before the chains do."""
        extent = np.array([[grey.shape[1], grey.shape[0]]], np.float32) / np.float32(max(grey.shape))
        known = {"view": view_of(grey)[None, None], "extent": extent}
        maps = np.asarray(self._front.run([self._maps], _asked(self._front, known))[0])
        known = {self._maps: np.concatenate([maps, mirrored_maps(maps)]), "extent": np.repeat(extent, 2, axis=0)}
        answers = self._trunk.run(self._between, _asked(self._trunk, known))
        return known | dict(zip(self._between, map(np.asarray, answers), strict=True))


def _asked(session: InferenceSession, known: Mapping[str, Float32]) -> dict[str, Float32]:
    """The inputs of a session among what is known."""
    return {one.name: known[one.name] for one in session.get_inputs()}
