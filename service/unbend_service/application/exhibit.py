"""Exhibits: what can be shown of an estimate, and all that a drawing of it needs."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from unbend_service.domain.frames import Frame
from unbend_service.domain.grid import Grid
from unbend_service.domain.guides import Guides


class Subject(StrEnum):
    """What is drawn."""

    GUIDES = "guides"
    GRID = "grid"
    DISPLACEMENT = "displacement"
    GRIDS = "grids"
    MAGNITUDE = "magnitude"
    SHEET = "sheet"

    @property
    def shows_result(self) -> bool:
        """Whether the corrected picture is part of it."""
        return self in (Subject.GRIDS, Subject.SHEET)


@dataclass(frozen=True, slots=True)
class Exhibit:
    """A picture and what is known of it.

    Attributes:
        frame: the distorted source; gray8, rgb24, bgr24, rgba or bgra.
        grid: as estimated, target -> source.
        guides: None if the grid came without any.
        straight: the corrected picture, of the size of ``frame``; None where the subject does not show it.
        drawn: the grid that ``straight`` was drawn through, with strength and fit.
    """

    frame: Frame
    grid: Grid
    guides: Guides | None = None
    straight: Frame | None = None
    drawn: Grid | None = None
