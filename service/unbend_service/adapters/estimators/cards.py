"""Model cards: what a weight file is, read from the ``.json`` that lies beside it.

A card is ``{"name", "kind", "sha256", "min_confidence", "full_confidence", "doubtful_px", "parameters"}``: ``kind``
says which estimator reads the weights, ``sha256`` is that of the ``.onnx`` file, and ``parameters`` are the estimator's
own. Below ``min_confidence`` (0 if left out) a picture's lens had better be left alone; below ``full_confidence`` (the
same if left out) be corrected by a mean displacement of ``doubtful_px`` at most, pixels of a picture 256 wide.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from unbend_service.domain.decision import Caution
from unbend_service.domain.errors import ModelUnavailable

SETTING = "model"


@dataclass(frozen=True, slots=True)
class ModelCard:
    """What the machine needs to know of a model.

    Attributes:
        name: as the setting ``model`` takes it.
        kind: which estimator reads the weights, a key of the catalogue.
        sha256: of the weight file, lower-case hex.
        caution: that is advised for a picture's lens.
        parameters: what that estimator wants to know besides.
        weights: the ``.onnx`` file.
    """

    name: str
    kind: str
    sha256: str
    caution: Caution
    parameters: dict[str, Any]
    weights: Path


def shipped_models() -> dict[str, Path]:
    """Name -> weight file of the models that ship with the service."""
    folder = Path(str(files("unbend_service"))) / "models"
    return {card.stem: card.with_suffix(".onnx") for card in sorted(folder.glob("*.json"))}


def read_card(model: str) -> ModelCard:
    """Finds a model and checks that its weights are those of its card.

    Args:
        model: the name of a model that ships, or a path to an ``.onnx`` file with its ``.json`` card beside it.

    Raises:
        ModelUnavailable: no such model, no card, or other weights than the card says.
    """
    shipped = shipped_models()
    weights = shipped.get(model, Path(model))
    if not weights.is_file():
        raise _unavailable(f"There is no model {model!r}.")
    path = weights.with_suffix(".json")
    try:
        fields = json.loads(path.read_text(encoding="utf-8"))
        card = ModelCard(
            name=str(fields["name"]),
            kind=str(fields["kind"]),
            sha256=str(fields["sha256"]),
            caution=_caution(fields),
            parameters=dict(fields.get("parameters", {})),
            weights=weights,
        )
    except FileNotFoundError:
        raise _unavailable(f"The model {model!r} has no card {path.name!r} beside it.") from None
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise _unavailable(f"The card {path.name!r} cannot be read: {error!r}.") from error
    _check(weights, card.sha256)
    return card


def _caution(fields: dict[str, Any]) -> Caution:
    least = float(fields.get("min_confidence", 0.0))
    return Caution(least, float(fields.get("full_confidence", least)), float(fields.get("doubtful_px", 0.0)) * 2 / 256)


def companion(card: ModelCard, part: str) -> Path:
    """A second weight file of a model, ``parameters[part] = {"weights", "sha256"}``, in the folder of the first.

    Raises:
        ModelUnavailable: it is not there, or not what the card says.
    """
    try:
        name, sha256 = str(card.parameters[part]["weights"]), str(card.parameters[part]["sha256"])
    except (KeyError, TypeError) as error:
        raise _unavailable(f"The card of {card.name!r} does not say where its {part} is: {error!r}.") from error
    weights = card.weights.with_name(name)
    if weights.parent != card.weights.parent or not weights.is_file():
        raise _unavailable(f"The model {card.name!r} lacks its {part}, {name!r}.")
    _check(weights, sha256)
    return weights


def _check(weights: Path, sha256: str) -> None:
    found = hashlib.sha256(weights.read_bytes()).hexdigest()
    if found != sha256:
        raise _unavailable(f"The weights {weights.name!r} are not those of their card: SHA-256 {found}.")


def _unavailable(message: str) -> ModelUnavailable:
    names = ", ".join(shipped_models())
    return ModelUnavailable(
        message, allowed=f"{names}, or the path to an .onnx file with its .json card beside it", setting=SETTING
    )
