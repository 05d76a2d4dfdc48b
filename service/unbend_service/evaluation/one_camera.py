"""Many pictures of one camera: each alone, and all together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from unbend_service.domain import aggregation
from unbend_service.evaluation.cases import Case, Photograph
from unbend_service.evaluation.families import distorted_case, draw, grey_square
from unbend_service.evaluation.methods import Look, Method, decided

if TYPE_CHECKING:
    from unbend_service.evaluation.suites import Measurement

FAMILIES = ("barrel", "pincushion", "wave", "mixed")
CAMERAS, PICTURES = 12, 10
TOGETHER = ", together"
"""What the group of a camera's fused answer ends in."""
_SEED = 31
_PIXELS = 128.0


def camera_cases(photographs: list[Photograph]) -> Iterator[list[Case]]:
    """For each camera its pictures: different photographs, one distortion."""
    rng = np.random.default_rng(_SEED)
    for number in range(CAMERAS):
        family = FAMILIES[number % len(FAMILIES)]
        straighten = draw(family, rng)
        chosen = rng.choice(len(photographs), min(PICTURES, len(photographs)), replace=False)
        yield [distorted_case(f"{family} {number + 1}", grey_square(photographs[i].pixels), straighten) for i in chosen]


def together(looks: Sequence[Look], method: Method) -> Look:
    """What the service makes of several looks at one camera's pictures."""
    fused = aggregation.fuse(
        [
            aggregation.Look(
                look.guides,
                look.confidence,
                None if look.expected_error_px is None else look.expected_error_px / _PIXELS,
            )
            for look in looks
            if look.guides is not None
        ]
    )
    error_px = fused.expected_error * _PIXELS
    return decided(fused.guides, fused.confidence, method.caution, error_px, sum(look.seconds for look in looks))


def camera_rows(measurements: Sequence[Measurement]) -> list[tuple[str, float, float, float]]:
    """Of each camera: its name, mean lens error px of doing nothing, of one picture, and of all together."""
    names = dict.fromkeys(m.group for m in measurements if not m.group.endswith(TOGETHER))
    rows = []
    for name in names:
        alone = [m for m in measurements if m.group == name]
        fused = [m.lens_px for m in measurements if m.group == name + TOGETHER]
        nothing, single = (float(np.mean([getattr(m, key) for m in alone])) for key in ("lens_nothing_px", "lens_px"))
        rows.append((name, nothing, single, fused[0]))
    return rows


def camera_table(measurements: Sequence[Measurement]) -> str:
    """Markdown."""
    rows = camera_rows(measurements)
    lines = ["| camera | nothing | one picture | together | of one |", "|---|---|---|---|---|"]
    for name, nothing, one, fused in rows:
        lines.append(f"| {name} | {nothing:.2f} | {one:.2f} | {fused:.2f} | {fused / one:.2f} |")
    nothing, one, fused = np.mean([row[1:] for row in rows], axis=0)
    lines.append(f"| **mean** | {nothing:.2f} | {one:.2f} | {fused:.2f} | **{fused / one:.2f}** |")
    return "\n".join(lines) + "\n"
