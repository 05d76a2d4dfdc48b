"""What is kept of an estimate: the grid, where it came from, and what was decided."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from unbend_service.domain.errors import InvalidGrid, InvalidInput, InvalidOption
from unbend_service.domain.grid import Grid
from unbend_service.domain.guides import Guides

_MAX_TEXT = 128


class Correct(StrEnum):
    """What is corrected: the homography-free part only, or all of the estimated map."""

    NONLINEAR = "nonlinear"
    ALL = "all"

    @classmethod
    def parse(cls, text: str) -> Correct:
        try:
            return cls(text)
        except ValueError:
            raise InvalidOption(f"correct={text!r} is not known.", allowed=", ".join(cls)) from None


class Outcome(StrEnum):
    """Whether the picture was changed."""

    CORRECTED = "corrected"
    LEFT_ALONE = "left_alone"


class Reason(StrEnum):
    """Why a picture was left alone, or corrected less than asked."""

    NONE = ""
    LOW_CONFIDENCE = "low_confidence"
    NOTHING_TO_CORRECT = "nothing_to_correct"
    FOLDED = "folded"


@dataclass(frozen=True)
class GridRecord:
    """A grid and its provenance.

    Attributes:
        grid: target -> source, centred; without fit, at full strength unless it was stored otherwise.
        guides: the guides it was spun from, None for grids that came from elsewhere.
        confidence: 0..1, 1.0 for grids made by hand.
        confidence_kind: what the confidence means (``mirror_agreement``, ``given`` ...).
        outcome, reason: what was decided.
        strength: share of the estimated correction that is in the grid.
        model: name of the network, empty for grids that came from elsewhere.

    Raises:
        InvalidGrid: confidence or strength outside 0..1.
    """

    grid: Grid
    guides: Guides | None = None
    confidence: float = 1.0
    confidence_kind: str = "given"
    outcome: Outcome = Outcome.CORRECTED
    reason: Reason = Reason.NONE
    strength: float = 1.0
    model: str = ""

    def __post_init__(self) -> None:
        for name, value in (("confidence", self.confidence), ("strength", self.strength)):
            if not 0 <= value <= 1:
                raise InvalidGrid(f"The {name} of a grid is {value!r}.", allowed="0..1")

    @property
    def id(self) -> str:
        return self.grid.id

    def to_dict(self) -> dict[str, Any]:
        """The JSON of /v1/estimate and /v1/grids."""
        return {**self.provenance(), "grid": self.grid.to_dict()}

    def provenance(self) -> dict[str, Any]:
        """The same without the grid."""
        return {
            "grid_id": self.id,
            "confidence": self.confidence,
            "confidence_kind": self.confidence_kind,
            "outcome": self.outcome.value,
            "reason": self.reason.value,
            "strength": self.strength,
            "guides": None if self.guides is None else self.guides.to_dict(),
            "model": self.model,
        }

    @classmethod
    def from_dict(cls, value: Any) -> GridRecord:
        """Inverse of :meth:`to_dict`; only ``grid`` is required. Raises InvalidGrid or InvalidGuides."""
        if not isinstance(value, dict) or "grid" not in value:
            raise InvalidGrid("A stored grid must be an object with a grid.")
        guides = value.get("guides")
        try:
            return cls(
                grid=Grid.from_dict(value["grid"]),
                guides=None if guides is None else Guides.from_dict(guides),
                confidence=_share(value, "confidence"),
                confidence_kind=_text(value, "confidence_kind", "given"),
                outcome=Outcome(value.get("outcome", "corrected")),
                reason=Reason(value.get("reason", "")),
                strength=_share(value, "strength"),
                model=_text(value, "model", ""),
            )
        except InvalidInput:
            raise
        except (TypeError, ValueError) as error:
            raise InvalidGrid("A field of the stored grid has the wrong type or value.") from error


def _share(value: dict[str, Any], name: str) -> float:
    share = value.get(name, 1.0)
    if isinstance(share, bool) or not isinstance(share, int | float) or not 0 <= share <= 1:
        raise InvalidGrid(f"{name} of the stored grid is {share!r:.40}.", allowed="a number 0..1")
    return float(share)


def _text(value: dict[str, Any], name: str, default: str) -> str:
    text = value.get(name, default)
    if not isinstance(text, str) or len(text) > _MAX_TEXT:
        raise InvalidGrid(f"{name} of the stored grid is not a short text.", allowed=f"at most {_MAX_TEXT} characters")
    return text
