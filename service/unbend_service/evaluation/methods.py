"""What is measured: models as the service runs them, and peers."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from unbend_service.application.ports import Estimator
from unbend_service.domain.decision import TRUSTING, Caution, decide
from unbend_service.domain.grid import Grid
from unbend_service.domain.guides import Guides
from unbend_service.domain.records import Correct, Outcome
from unbend_service.evaluation.cases import Case
from unbend_service.evaluation.peers import PlumblinePeer, floor_of, one_radial_parameter

GRID_POINTS = 65
FLOORS = ((2, 3), (4, 3), (4, 5), (6, 5))
"""Guides a direction and their degree: the paper's, and finer ones."""


@dataclass(frozen=True, eq=False)
class Look:
    """What a method makes of one picture.

    Attributes:
        guides: None where it has none.
        lens, everything: the grids of `correct=nonlinear` and `correct=all`, whatever the confidence.
        applied: the grid of `correct=nonlinear` with the caution that the model's card advises, as the service uses it.
        confidence: 0..1.
        applies: whether that corrects anything.
        expected_error_px: of the lens, px at 256 wide; None where the method has no say.
        seconds: that the look took.
    """

    guides: Guides | None
    lens: Grid
    everything: Grid
    applied: Grid
    confidence: float
    applies: bool
    expected_error_px: float | None
    seconds: float


@dataclass(frozen=True)
class Method:
    """Something that looks at pictures.

    Attributes:
        name: in tables.
        look: what it makes of a case; peers that know the truth are told it, models see the picture alone.
        caution: that its card advises.
    """

    name: str
    look: Callable[[Case], Look]
    caution: Caution


def model_method(estimator: Estimator, name: str | None = None) -> Method:
    """An estimator, decided on as in the service."""
    caution = estimator.model.caution

    def look(case: Case) -> Look:
        started = time.perf_counter()
        estimate = estimator.estimate(case.picture)
        seconds = time.perf_counter() - started
        return decided(
            estimate.guides,
            estimate.confidence,
            caution,
            None if estimate.expected_error is None else estimate.expected_error * 128,
            seconds,
        )

    return Method(name or estimator.model.name, look, caution)


def guides_method(name: str, examine: Callable[[Case], Guides]) -> Method:
    """A peer that answers with guides and never says no."""

    def look(case: Case) -> Look:
        started = time.perf_counter()
        guides = examine(case)
        return decided(guides, 1.0, TRUSTING, None, time.perf_counter() - started)

    return Method(name, look, TRUSTING)


def peer_methods(estimator: Estimator) -> list[Method]:
    """Doing nothing, the plumb-line, one radial parameter (of this model's answers), the floors and the true map."""
    plumbline = PlumblinePeer()
    floors = [
        guides_method(f"floor: {count} guides of degree {degree}", partial(floor_of, count, degree))
        for count, degree in FLOORS
    ]
    return [
        doing_nothing(),
        guides_method("plumb-line", lambda case: plumbline.examine(case.picture)),
        guides_method(
            f"one radial parameter of {estimator.model.name}",
            lambda case: one_radial_parameter(estimator, case.picture),
        ),
        *floors,
        knowing_the_truth(),
    ]


def doing_nothing() -> Method:
    identity = Grid.identity(GRID_POINTS, GRID_POINTS)
    look = Look(None, identity, identity, identity, 1.0, False, 0.0, 0.0)
    return Method("doing nothing", lambda case: look, TRUSTING)


def knowing_the_truth() -> Method:
    """The true map on the service's lattice: what a perfect estimate would reach."""

    def look(case: Case) -> Look:
        grid = Grid.from_map(
            lambda target: np.nan_to_num(case.truth(target), nan=8.0).clip(-8, 8), GRID_POINTS, GRID_POINTS
        )
        return Look(None, grid, grid, grid, 1.0, True, 0.0, 0.0)

    return Method("the true map", look, TRUSTING)


def decided(
    guides: Guides, confidence: float, caution: Caution, expected_error_px: float | None, seconds: float
) -> Look:
    """An estimate as the service decides on it."""
    lens, everything, applied = (
        decide(guides, confidence, "", "", correct=correct, caution=careful, points=GRID_POINTS)
        for correct, careful in (
            (Correct.NONLINEAR, TRUSTING),
            (Correct.ALL, TRUSTING),
            (Correct.NONLINEAR, caution),
        )
    )
    applies = applied.outcome is Outcome.CORRECTED
    return Look(guides, lens.grid, everything.grid, applied.grid, confidence, applies, expected_error_px, seconds)
