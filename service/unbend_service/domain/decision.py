"""From what an estimator says to the grid that is used, or to leaving the picture alone."""

from __future__ import annotations

from unbend_service.domain.errors import InvalidGrid, InvalidGuides
from unbend_service.domain.fit import with_strength
from unbend_service.domain.grid import DEFAULT_POINTS, Grid
from unbend_service.domain.guides import Guides
from unbend_service.domain.homography import without_plane_part
from unbend_service.domain.records import Correct, GridRecord, Outcome, Reason

#: A mean displacement below a tenth of a pixel of a 256 pixel wide picture is not worth resampling for.
NOTHING_TO_CORRECT = 0.1 * 2 / 256
#: Strengths that are tried in turn while the grid folds.
_STRENGTHS = (1.0, 0.75, 0.5, 0.25)


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
    min_confidence: float,
    points: int = DEFAULT_POINTS,
) -> GridRecord:
    """What is done with an estimate.

    The grid is the identity when the picture is left alone: the confidence is below ``min_confidence``, the estimated
    displacement is negligible, or the grid folds at every strength. The guides are reported as they were estimated.
    """

    def record(grid: Grid, outcome: Outcome, reason: Reason, strength: float) -> GridRecord:
        return GridRecord(grid, guides, confidence, confidence_kind, outcome, reason, strength, model)

    identity = Grid.identity(points, points)
    if confidence < min_confidence:
        return record(identity, Outcome.LEFT_ALONE, Reason.LOW_CONFIDENCE, 0.0)
    try:
        grid = spin_grid(guides, correct, points)
    except (InvalidGuides, InvalidGrid):
        return record(identity, Outcome.LEFT_ALONE, Reason.FOLDED, 0.0)
    if grid.displacement < NOTHING_TO_CORRECT:
        return record(identity, Outcome.LEFT_ALONE, Reason.NOTHING_TO_CORRECT, 0.0)
    for strength in _STRENGTHS:
        weaker = with_strength(grid, strength)
        if weaker.is_unfolded:
            reason = Reason.NONE if strength == 1 else Reason.FOLDED
            return record(weaker, Outcome.CORRECTED, reason, strength)
    return record(identity, Outcome.LEFT_ALONE, Reason.FOLDED, 0.0)
