"""The figures of an evaluation: curves of all measurements, and sheets of single pictures.

A sheet shows pictures, so it is made only of photographs whose source may be shown (`shown_sources`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from unbend_service.domain.grid import Grid
from unbend_service.domain.maps import BackwardMap, target_lattice
from unbend_service.evaluation.cases import Bytes, Case, Float64
from unbend_service.evaluation.methods import Look
from unbend_service.evaluation.plots import Line, plot
from unbend_service.evaluation.suites import Measurement, rendered
from unbend_service.evaluation.tables import MOVED_PX, harm_at

_BINS = 8
_FEWEST_IN_BIN = 8
_BETTER_SHARE = 0.99
_LINES = 9
_FOUND_BGR, _TRUE_BGR, _ROW_BGR, _COLUMN_BGR = (40, 120, 255), (90, 200, 60), (0, 176, 255), (255, 200, 86)
_CAPTION_PX = 18
_WORTH_SHOWING_PX = 1.0


def reliability_plot(by_method: Mapping[str, Sequence[Measurement]]) -> str:
    """How often the lens came out better than it was, against the confidence, in bins of equally many pictures."""
    lines = [Line("as often as said", [(0, 0), (1, 1)], dashed=True)]
    for name, measurements in by_method.items():
        ordered = sorted(measurements, key=lambda m: m.confidence)
        size = max(_FEWEST_IN_BIN, len(ordered) // _BINS)
        bins = [ordered[i : i + size] for i in range(0, len(ordered) - size + 1, size)]
        points = [
            (
                float(np.mean([m.confidence for m in own])),
                float(np.mean([m.lens_px < _BETTER_SHARE * m.lens_nothing_px for m in own])),
            )
            for own in bins
        ]
        lines.append(Line(name, points))
    return plot("Reliability", "confidence", "share that became straighter", lines, 1.0, 1.0)


def threshold_plot(undistorted: Mapping[str, Sequence[Measurement]], bent: Mapping[str, Sequence[Measurement]]) -> str:
    """What each threshold costs and gains: undistorted pictures moved, against bent ones corrected."""
    lines = []
    for name, own in undistorted.items():
        points, labels = [], []
        for threshold in (0.0, 0.3, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95):
            moved, corrected, _, _ = harm_at(own, bent.get(name, ()), threshold)
            if np.isnan(corrected):
                continue
            points.append((float((moved >= MOVED_PX).mean()), corrected))
            labels.append(f"{threshold:g}")
        lines.append(Line(name, points, labels))
    reach = max([x for line in lines for x, _ in line.points] + [0.1])
    return plot(
        "Threshold",
        "undistorted pictures moved by 0.5 px or more",
        "bent by more than 2 px, corrected",
        lines,
        reach,
        1,
    )


@dataclass
class Gallery:
    """Keeps the pictures of the best and the worst estimates, for the sheets; its `see` is a witness of a suite."""

    shown_sources: frozenset[str]
    size: int = 5
    best: list[tuple[float, Case, Look, Measurement]] = field(default_factory=list)
    worst: list[tuple[float, Case, Look, Measurement]] = field(default_factory=list)

    def see(self, case: Case, look: Look, measurement: Measurement) -> None:
        if case.source not in self.shown_sources or measurement.lens_nothing_px < _WORTH_SHOWING_PX:
            return
        entry = (measurement.lens_px / measurement.lens_nothing_px, case, look, measurement)
        self.best = sorted([*self.best, entry], key=lambda one: one[0])[: self.size]
        self.worst = sorted([*self.worst, entry], key=lambda one: -one[0])[: self.size]

    def write(self, folder: Path) -> list[str]:
        """successes.jpg and failures.jpg, with what there is; the names of those written."""
        names = []
        for name, entries in (("successes", self.best), ("failures", self.worst)):
            if entries:
                rows = [case_row(case, look, measurement) for _, case, look, measurement in entries]
                cv2.imwrite(str(folder / f"{name}.jpg"), np.concatenate(rows), [cv2.IMWRITE_JPEG_QUALITY, 85])
                names.append(name)
        return names


def case_row(case: Case, look: Look, measurement: Measurement) -> Bytes:
    """One picture: as it came, guides, estimated and true grid over it, displacement, corrected, truly corrected."""
    picture = _colour(case.picture)
    left_px = f"{measurement.error_px:.2f} of {measurement.nothing_px:.2f} px"
    everything = look.everything
    guides = picture.copy()
    if look.guides is not None:
        ends = np.linspace(-1, 1, 65)
        for family, upright in ((look.guides.rows, False), (look.guides.columns, True)):
            for curve in family.coefficients:
                across = np.polynomial.polynomial.polyval(ends, curve)
                points = np.stack([across, ends] if upright else [ends, across], 1)
                _draw(guides, points, _COLUMN_BGR if upright else _ROW_BGR, 2)
    grids = picture.copy()
    for backward, colour in ((case.truth, _TRUE_BGR), (everything, _FOUND_BGR)):
        _draw_grid(grids, backward, colour)
    true_grid = Grid.from_map(lambda target: np.nan_to_num(case.truth(target), nan=8.0).clip(-8, 8), 65, 65)
    panels = [
        (picture, f"{case.group}: {measurement.lens_nothing_px:.2f} px bent"),
        (guides, "guides"),
        (grids, "grid: true green, found orange"),
        (_displacement(picture, everything), "displacement"),
        (_colour(rendered(case.picture, look.lens)), f"lens corrected: {measurement.lens_px:.2f} px left"),
        (
            _colour(rendered(case.picture, everything)),
            f"all: {left_px} left",
        ),
        (_colour(rendered(case.picture, true_grid)), "truly corrected"),
    ]
    return np.concatenate([_captioned(np.asarray(panel, np.uint8), words) for panel, words in panels], axis=1)


def _draw_grid(canvas: Bytes, backward: BackwardMap, colour: tuple[int, int, int]) -> None:
    along = np.linspace(-1, 1, 49)
    for position in np.linspace(-1, 1, _LINES):
        level = np.full_like(along, position)
        for target in (np.stack([along, level], 1), np.stack([level, along], 1)):
            _draw(canvas, backward(target), colour, 1)


def _draw(canvas: Bytes, points: Float64, colour: tuple[int, int, int], width: int) -> None:
    height, long = canvas.shape[:2]
    pixels = (points + 1) / 2 * np.array([long, height]) - 0.5
    usable = np.isfinite(pixels).all(1) & (np.abs(points) < 2).all(1)
    for run in np.split(np.arange(len(points)), np.flatnonzero(np.diff(usable.astype(int))) + 1):
        if usable[run].all() and len(run) > 1:
            cv2.polylines(canvas, [np.rint(pixels[run] * 16).astype(np.int32)], False, colour, width, cv2.LINE_AA, 4)


def _displacement(picture: Bytes, grid: Grid) -> Bytes:
    height, width = picture.shape[:2]
    canvas = cv2.addWeighted(picture, 0.5, np.full_like(picture, 255), 0.5, 0)
    target = target_lattice(_LINES, _LINES, 0.9).reshape(-1, 2)
    size = np.array([width, height])
    for start, end in zip((target + 1) / 2 * size, (grid(target) + 1) / 2 * size, strict=True):
        begin, finish = (tuple(int(v) for v in np.rint(point)) for point in (start, end))
        cv2.arrowedLine(canvas, begin, finish, (60, 60, 200), 1, cv2.LINE_AA, tipLength=0.25)
    return np.asarray(canvas, np.uint8)


def _colour(grey: Bytes) -> Bytes:
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), np.uint8)


def _captioned(panel: Bytes, words: str) -> Bytes:
    strip = np.full((_CAPTION_PX, panel.shape[1], 3), 255, np.uint8)
    cv2.putText(strip, words, (4, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.38, (20, 20, 20), 1, cv2.LINE_AA)
    return np.concatenate([strip, panel])
