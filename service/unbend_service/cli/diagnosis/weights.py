"""The model: is it there, is it what its card says, does it load."""

from __future__ import annotations

from unbend_service.adapters.estimators.cards import read_card, shipped_models
from unbend_service.adapters.estimators.catalogue import load_estimator
from unbend_service.cli.diagnosis.finding import Finding
from unbend_service.domain.errors import UnbendError
from unbend_service.settings import Settings


def examine_model(settings: Settings) -> Finding:
    """Reads the card, compares the checksum of the weights, loads them."""
    try:
        card = read_card(settings.model)
        load_estimator(settings.model, 1)
    except UnbendError as error:
        names = ", ".join(shipped_models())
        return Finding(
            "model",
            "bad",
            error.message,
            f"set UNBEND_MODEL to one that ships ({names}), or to an .onnx file with its own .json card beside it",
        )
    size_mb = card.weights.stat().st_size / 1e6
    detail = f"{card.name} ({card.kind}, {size_mb:.1f} MB), sha256 {card.sha256[:16]}… as its card says"
    return Finding("model", "ok", detail)
