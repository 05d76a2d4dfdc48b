"""From what an estimator says to the grid that is used, or to leaving the picture alone."""

from __future__ import annotations

import math
from dataclasses import dataclass

from unbend_service.domain.errors import InvalidGrid, InvalidGuides
from unbend_service.domain.fit import with_strength
from unbend_service.domain.grid import DEFAULT_POINTS, Grid
from unbend_service.domain.guides import Guides
from unbend_service.domain.homography import without_plane_part
from unbend_service.domain.records import Correct, GridRecord, Outcome, Reason

#: A mean displacement below a tenth of a pixel of a 256 pixel wide picture is not worth resampling for.
NOTHING_TO_CORRECT = 0.1 * 2 / 256
#: Shares of what is trusted, tried in turn while the grid folds.
_STRENGTHS = (1.0, 0.75, 0.5, 0.25)


@dataclass(frozen=True, slots=True)
class Caution:
    """How sure an estimate has to be.

    Attributes:
        min_confidence: 0..1; below it a picture is left alone.
        full_confidence: from here on an estimate is followed all the way. Between the two it is followed in part.
        doubtful_displacement: how far, on average, such a part may move the picture; half picture widths.
    """

    min_confidence: float = 0.0
    full_confidence: float = 0.0
    doubtful_displacement: float = 0.0

    def furthest(self, confidence: float) -> float:
        """How far a correction of this confidence may move the picture on average, half picture widths."""
        if confidence < self.min_confidence:
            return 0.0
        return math.inf if confidence >= self.full_confidence else self.doubtful_displacement


#: Follows every estimate all the way.
TRUSTING = Caution()


def spin_grid(guides: Guides, correct: Correct, points: int = DEFAULT_POINTS) -> Grid:
    """The lattice of the guides' map, or of what a homography leaves of it.

    Raises:
        InvalidGuides: the guides do not intersect.
        InvalidGrid: they show almost nothing of the source.
    """
    backward = guides if correct is Correct.ALL else without_plane_part(guides)
    return Grid.from_map(backward, points, points)


def decide(
    guides: Guides,
    confidence: float,
    confidence_kind: str,
    model: str,
    *,
    correct: Correct,
    caution: Caution,
    points: int = DEFAULT_POINTS,
) -> GridRecord:
    """What is done with an estimate.

    The grid is the identity when the picture is left alone: the confidence is below that of ``caution``, the estimated
    displacement is negligible, or the grid folds at every strength. It holds a part of the correction, and the reason
    says so, where all of it would fold, or is doubtful and would move the picture further than ``caution`` allows. The
    guides are reported as they were estimated.
    """

    def record(grid: Grid, outcome: Outcome, reason: Reason, strength: float) -> GridRecord:
        return GridRecord(grid, guides, confidence, confidence_kind, outcome, reason, strength, model)

    identity = Grid.identity(points, points)
    furthest = caution.furthest(confidence)
    if furthest == 0:
        return record(identity, Outcome.LEFT_ALONE, Reason.LOW_CONFIDENCE, 0.0)
    try:
        grid = spin_grid(guides, correct, points)
    except (InvalidGuides, InvalidGrid):
        return record(identity, Outcome.LEFT_ALONE, Reason.FOLDED, 0.0)
    if grid.displacement < NOTHING_TO_CORRECT:
        return record(identity, Outcome.LEFT_ALONE, Reason.NOTHING_TO_CORRECT, 0.0)
    trusted = min(1.0, furthest / grid.displacement)
    for share in _STRENGTHS:
        strength = share * trusted
        weaker = with_strength(grid, strength)
        if weaker.is_unfolded:
            doubted = Reason.LOW_CONFIDENCE if trusted < 1 else Reason.NONE
            return record(weaker, Outcome.CORRECTED, doubted if share == 1 else Reason.FOLDED, strength)
    return record(identity, Outcome.LEFT_ALONE, Reason.FOLDED, 0.0)
