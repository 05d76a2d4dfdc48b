"""Measuring an estimator on whole pictures, in this process: decoded picture in, guides out, as in the service.

End-point errors (EPE) of the backward map are in pixels of a 256 picture, over the part of the target that the
distorted picture shows: of everything (`all`), and up to the best target-side homography (`nonlinear`), which asks
only that straight lines be straight. Doing nothing is measured beside every figure.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from training.distortions import DistortionBatch
from training.protocol import FAMILIES, LZSL_SIX, Bytes, cases
from unbend_service.adapters.estimators.lineset import Evidence, LinesetEstimator
from unbend_service.application.ports import Estimator
from unbend_service.domain.decision import TRUSTING, Caution, decide
from unbend_service.domain.errors import InvalidGuides
from unbend_service.domain.grid import Grid
from unbend_service.domain.guides import Guides
from unbend_service.domain.maps import BackwardMap, target_lattice
from unbend_service.domain.records import Correct
from unbend_service.evaluation.measures import as_rendered

Float64 = npt.NDArray[np.float64]

PIXELS = 128.0
_LATTICE = 25
_FULL_LONG_SIDE_PX = 512
WHOLE = "whole"
"""Family of undistorted whole photographs."""


@dataclass(frozen=True)
class Measurement:
    """One picture: errors in px at 256, of doing nothing, of the estimate, and of what the service would make of it."""

    family: str
    overall_nothing: float
    overall: float
    nonlinear_nothing: float
    nonlinear: float
    applied: float
    strength: float
    evidence: Evidence | None
    confidence: float


def measure(
    estimator: Estimator,
    photographs: list[Bytes],
    families: Iterable[str] = FAMILIES,
    seed: int | None = None,
    caution: Caution | None = None,
) -> list[Measurement]:
    """Every photograph under every family; see `protocol.cases` for the seed. Without a caution, that of the card."""
    caution = caution or estimator.model.caution
    measurements = []
    for family in families:
        for case in cases(family, photographs, seed):
            guides, evidence, confidence = _look(estimator, case.picture)
            target, truth = true_correspondences(case.distortion)
            overall_nothing, nonlinear_nothing = map_errors(lambda points: points, target, truth)
            try:
                overall, nonlinear = map_errors(guides, target, truth)
            except InvalidGuides:  # the service leaves such a picture alone
                overall, nonlinear, confidence = overall_nothing, nonlinear_nothing, 0.0
            grid, strength = _applied(guides, confidence, caution)
            applied = map_errors(as_rendered(grid), target, truth)[1] if strength else nonlinear_nothing
            measurements.append(
                Measurement(
                    family=family,
                    overall_nothing=overall_nothing,
                    overall=overall,
                    nonlinear_nothing=nonlinear_nothing,
                    nonlinear=nonlinear,
                    applied=applied,
                    strength=strength,
                    evidence=evidence,
                    confidence=confidence,
                )
            )
    return measurements


def _applied(guides: Guides, confidence: float, caution: Caution) -> tuple[Grid, float]:
    """What the service would make of it, and how much of the estimate that is."""
    record = decide(guides, confidence, "", "", correct=Correct.NONLINEAR, caution=caution)
    return record.grid, record.strength


def _look(estimator: Estimator, picture: Bytes) -> tuple[Guides, Evidence | None, float]:
    if isinstance(estimator, LinesetEstimator):
        guides, evidence = estimator.examine(picture)
        return guides, evidence, estimator.confidence(evidence)
    estimate = estimator.estimate(picture)
    return estimate.guides, None, estimate.confidence


def true_correspondences(distortion: DistortionBatch) -> tuple[Float64, Float64]:
    """Target points whose true source lies in the picture, and that source: both (n, 2), square pictures."""
    lattice = target_lattice(_LATTICE, _LATTICE, 1 - 1 / _LATTICE).reshape(-1, 2)
    x, y, visible = distortion.bend(
        lattice[:, 0].astype(np.float32), lattice[:, 1].astype(np.float32), np.zeros(len(lattice), np.int64)
    )
    source = np.stack([x, y], 1).astype(np.float64)
    shown = visible & (np.abs(source) <= 1).all(1)
    return lattice[shown], source[shown]


def map_errors(backward: BackwardMap, target: Float64, truth: Float64) -> tuple[float, float]:
    """Mean EPE of a backward map, px: of everything, and after the best homography of the target."""
    missed = backward(target) - truth
    return float(np.hypot(*missed.T).mean() * PIXELS), float(_aligned_error(backward, target, truth) * PIXELS)


def _aligned_error(backward: BackwardMap, target: Float64, truth: Float64) -> float:
    """Mean error after Gauss-Newton (Levenberg) on the 8 numbers of S in |backward(S(target)) - truth|^2."""
    parameters, damping = np.zeros(8), 1e-6
    residual, jacobian = _residual(backward, target, truth, parameters)
    for _ in range(15):
        normal, right = jacobian.T @ jacobian, jacobian.T @ residual.ravel()
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-9), -right)
        tried, tried_jacobian = _residual(backward, target, truth, parameters + step)
        gained = (residual**2).sum() - (tried**2).sum()
        if gained > 0:
            settled = gained < 1e-5 * (residual**2).sum()
            parameters, residual, jacobian, damping = parameters + step, tried, tried_jacobian, max(damping / 5, 1e-9)
            if settled:
                break
        else:
            damping *= 10
            if damping > 1e5:
                break
    return float(np.hypot(*residual.T).mean())


def _residual(backward: BackwardMap, target: Float64, truth: Float64, p: Float64) -> tuple[Float64, Float64]:
    """backward(S(target)) - truth (n, 2), and its derivative by the parameters (2 n, 8), x and y interleaved."""
    s, t = target.T
    matrix = np.array([[1 + p[0], p[1], p[2]], [p[3], 1 + p[4], p[5]], [p[6], p[7], 1.0]])
    projected = np.stack([s, t, np.ones_like(s)], 1) @ matrix.T
    depth = np.maximum(projected[:, 2:], 0.05)
    moved = (projected[:, :2] / depth).clip(-3, 3)
    step = 1e-4
    here = backward(moved)
    by_s = (backward(moved + np.array([step, 0])) - here) / step
    by_t = (backward(moved + np.array([0, step])) - here) / step
    zero, one = np.zeros_like(s), np.ones_like(s)
    of_s = np.stack([s, t, one, zero, zero, zero, -moved[:, 0] * s, -moved[:, 0] * t], 1) / depth
    of_t = np.stack([zero, zero, zero, s, t, one, -moved[:, 1] * s, -moved[:, 1] * t], 1) / depth
    jacobian = by_s[:, :, None] * of_s[:, None, :] + by_t[:, :, None] * of_t[:, None, :]
    return here - truth, jacobian.reshape(-1, 8)


def measure_whole(estimator: Estimator, photographs: list[Bytes], caution: Caution | None = None) -> list[Measurement]:
    """Undistorted whole photographs, 512 px on the long side: `nonlinear` and `applied` are by how much the nonlinear
    correction would move them on average, px at 256 on the long side."""
    caution = caution or estimator.model.caution
    measurements = []
    for photograph in photographs:
        scale = _FULL_LONG_SIDE_PX / max(photograph.shape[:2])
        small = cv2.resize(photograph, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        grey = np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY), np.uint8)
        guides, evidence, confidence = _look(estimator, grey)
        moved = _displacement(_applied(guides, 1.0, TRUSTING)[0], grey)
        grid, strength = _applied(guides, confidence, caution)
        measurements.append(
            Measurement(
                family=WHOLE,
                overall_nothing=0.0,
                overall=moved,
                nonlinear_nothing=0.0,
                nonlinear=moved,
                applied=_displacement(grid, grey),
                strength=strength,
                evidence=evidence,
                confidence=confidence,
            )
        )
    return measurements


def _displacement(grid: Grid, grey: Bytes) -> float:
    """Mean, px at 256 on the long side."""
    offset = (grid.source - target_lattice(grid.rows, grid.columns)) * np.array(grey.shape[::-1]) / max(grey.shape)
    return float(np.hypot(offset[..., 0], offset[..., 1]).mean() * PIXELS)


def table(measurements: list[Measurement], title: str) -> str:
    """Markdown: errors by family with the do-nothing line, as estimated and as the service applies it."""
    lines = [
        f"### {title}",
        "",
        "| family | n | all: nothing | all | median | up to a homography: nothing | raw | median |"
        " applied | made worse | corrected |",
        "|" + "---|" * 11,
    ]
    distorted = [m for m in measurements if m.family != WHOLE]
    for family in dict.fromkeys(m.family for m in distorted):
        own = [m for m in distorted if m.family == family]
        nothing_all, overall, nothing, raw, applied, strength = (
            np.array([getattr(m, name) for m in own])
            for name in ("overall_nothing", "overall", "nonlinear_nothing", "nonlinear", "applied", "strength")
        )
        lines.append(
            f"| {family} | {len(own)} | {nothing_all.mean():.2f} | {overall.mean():.2f} |"
            f" {np.median(overall):.2f} | {nothing.mean():.2f} | {raw.mean():.2f} | {np.median(raw):.2f} |"
            f" {applied.mean():.2f} | {(applied > nothing + 0.25).mean():.2f} | {(strength > 0).mean():.2f} |"
        )
    six = [[(m.overall_nothing, m.overall) for m in distorted if m.family == family] for family in LZSL_SIX]
    if all(six):
        nothing_mean, mean = np.mean([np.mean(pairs, 0) for pairs in six], 0)
        lines += ["", f"All, mean of six: {nothing_mean:.2f} (nothing) -> **{mean:.2f}**."]
    whole = [m for m in measurements if m.family == WHOLE]
    if whole:
        raw, moved = (np.array([getattr(m, name) for m in whole]) for name in ("nonlinear", "applied"))
        lines += [
            "",
            f"Undistorted photographs (n={len(whole)}), nonlinear displacement px: raw mean {raw.mean():.3f},"
            f" p95 {np.percentile(raw, 95):.2f}, below 0.5 px {(raw < 0.5).mean():.3f};"
            f" applied mean {moved.mean():.3f}, p95 {np.percentile(moved, 95):.2f}, below 0.5 px"
            f" {(moved < 0.5).mean():.3f}.",
        ]
    return "\n".join(lines) + "\n"


def write(text: str, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
