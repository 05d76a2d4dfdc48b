"""Figures of an evaluation: from numbers to curves, from cases to sheets."""

from __future__ import annotations

import dataclasses
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import cv2
import numpy as np

from unbend_service.domain.guides import Guides
from unbend_service.evaluation.cases import Case, Photograph
from unbend_service.evaluation.families import SIX, family_cases, table_one_cases
from unbend_service.evaluation.figures import Gallery, reliability_plot, threshold_plot
from unbend_service.evaluation.methods import doing_nothing, guides_method, knowing_the_truth
from unbend_service.evaluation.peers import floor_of
from unbend_service.evaluation.suites import SYNTHETIC, TABLE_ONE, Measurement, measure, run_suite
from unbend_service.evaluation.tables import quality_table

MEASURED = Measurement("barrel", 0, 6.0, 3.0, 4.0, 1.0, 1.0, 2.0, 2.0, 0.9, True, 1.0, 0.01)


def photograph(source: str = "free") -> Photograph:
    noise = np.random.default_rng(5).integers(0, 256, (30, 40, 3), dtype=np.uint8)
    return Photograph(cv2.resize(noise, (640, 480), interpolation=cv2.INTER_CUBIC), source, Path("drawn.png"))


def circles(svg: str) -> list[tuple[float, float]]:
    root = ElementTree.fromstring(svg)
    return [(float(c.get("cx", 0)), float(c.get("cy", 0))) for c in root.iter("{http://www.w3.org/2000/svg}circle")]


def test_reliability_rises_where_the_confidence_is_right() -> None:
    """Twenty pictures that became worse at 0.1, twenty that became better at 0.9: low left, high right."""
    worse = [dataclasses.replace(MEASURED, confidence=0.1, lens_px=5.0)] * 20
    better = [dataclasses.replace(MEASURED, confidence=0.9)] * 20
    points = circles(reliability_plot({"a": [*better, *worse]}))
    assert points[0][0] < points[-1][0]
    assert points[0][1] > points[-1][1]


def test_a_higher_threshold_spares_more_undistorted_pictures() -> None:
    """The curve goes down and to the left."""
    straight = [dataclasses.replace(MEASURED, confidence=c) for c in (0.1, 0.4, 0.85)]
    bent = [dataclasses.replace(MEASURED, confidence=c) for c in (0.2, 0.75, 0.99)]
    points = circles(threshold_plot({"a": straight}, {"a": bent}))
    assert [x for x, _ in points] == sorted((x for x, _ in points), reverse=True)
    assert [y for _, y in points] == sorted(y for _, y in points)


def test_sheets_show_only_what_may_be_shown(tmp_path: Path) -> None:
    """Photographs under a research licence appear in no figure."""
    gallery = Gallery(frozenset({"free"}))
    nothing = doing_nothing()
    for source in ("research", "free"):
        case = next(family_cases("wave", [photograph(source)]))
        look = nothing.look(case)
        gallery.see(case, look, dataclasses.replace(measure(case, look), lens_nothing_px=5.0))
    assert [case.source for _, case, _, _ in gallery.best] == ["free"]
    assert gallery.write(tmp_path) == ["successes", "failures"]
    height, width = cv2.imread(str(tmp_path / "failures.jpg")).shape[:2]
    assert (height, width) == (274, 7 * 256)


def test_knowing_the_truth_leaves_nothing_and_doing_nothing_leaves_all() -> None:
    """The ends of the scale on which models stand; finer guides come nearer to the truth."""
    methods = [doing_nothing(), knowing_the_truth()]
    methods += [guides_method(f"{k}", lambda case, k=k: floor_of(k, 3, case)) for k in (2, 4)]
    measured = run_suite(SYNTHETIC, methods, [photograph()], families=("barrel",))
    nothing, truth, coarse, fine = (own[0] for own in measured.values())
    assert nothing.error_px == nothing.nothing_px > 0.5
    assert truth.error_px < 0.05
    assert truth.ssim > nothing.ssim
    assert truth.error_px < fine.error_px < coarse.error_px < nothing.error_px


def test_table_one_mixes_the_six_families() -> None:
    """In turn, so that each has the same weight."""
    cases: list[Case] = list(table_one_cases([photograph()] * 7))
    assert [case.group for case in cases] == [*SIX, SIX[0]]
    text = quality_table(run_suite(TABLE_ONE, [doing_nothing()], [photograph()] * 2))
    assert "| doing nothing | 2 |" in text
    assert "Doing nothing: SSIM" in text


def test_peers_answer_with_guides() -> None:
    """So that the service's own decision applies to them."""
    case = next(family_cases("none", [photograph()]))
    look = guides_method("straight", lambda _: Guides.straight()).look(case)
    assert look.guides is not None
    assert not look.applies
    assert measure(case, look).error_px < 1e-6
