"""Which estimator reads which kind of model."""

from __future__ import annotations

from collections.abc import Callable

from unbend_service.adapters.estimators.cards import SETTING, ModelCard, read_card
from unbend_service.adapters.estimators.coefficients import CoefficientsEstimator
from unbend_service.adapters.estimators.first import FirstEstimator
from unbend_service.adapters.estimators.lineset import LinesetEstimator
from unbend_service.application.ports import Estimator
from unbend_service.domain.errors import ModelUnavailable

#: ``kind`` of a card -> what makes an estimator of (card, threads).
KINDS: dict[str, Callable[[ModelCard, int], Estimator]] = {
    "coefficients": CoefficientsEstimator,
    "lineset": LinesetEstimator,
    "picture": FirstEstimator,
}


def load_estimator(model: str, threads: int = 0) -> Estimator:
    """Loads a model and what reads it.

    Args:
        model: the name of a model that ships, or a path to an ``.onnx`` file with its ``.json`` card beside it.
        threads: of one estimate; 0: as many as usable cores.

    Raises:
        ModelUnavailable: names the setting and the models that ship.
    """
    card = read_card(model)
    if card.kind not in KINDS:
        raise ModelUnavailable(
            f"The model {model!r} is of the unknown kind {card.kind!r}.", allowed=", ".join(KINDS), setting=SETTING
        )
    return KINDS[card.kind](card, threads)
