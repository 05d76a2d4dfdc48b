"""Markdown tables of measurements, doing nothing beside every figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from unbend_service.evaluation.families import SIX
from unbend_service.evaluation.lenses import is_straight
from unbend_service.evaluation.oblique import OBLIQUE, UPRIGHT
from unbend_service.evaluation.suites import Measurement

MOVED_PX = 0.5
"""Displacement from which an undistorted picture counts as moved."""
BENT_PX = 2.0
"""Error from which a bent picture is expected to be corrected."""
_HARM_SHARE, _HARM_PX = 1.1, 0.1
_MUCH_WORSE_PX = 0.25
_UNPUBLISHED = (
    "The paper's own rows are not repeated here: its text was not at hand, its pictures are not public, and figures of"
    " other pictures would not compare."
)


@dataclass(frozen=True)
class LensRow:
    """One camera: mean EPE up to a homography, px, of doing nothing, of every estimate, as the service applies it."""

    camera: str
    pictures: int
    nothing_px: float
    estimated_px: float
    applied_px: float
    harmed: float

    @property
    def removed(self) -> float:
        return 1 - self.estimated_px / self.nothing_px

    @property
    def removed_as_applied(self) -> float:
        return 1 - self.applied_px / self.nothing_px


def groups(measurements: Sequence[Measurement]) -> dict[str, list[Measurement]]:
    """By group, in the order in which they come."""
    found: dict[str, list[Measurement]] = {}
    for measurement in measurements:
        found.setdefault(measurement.group, []).append(measurement)
    return found


def lens_rows(measurements: Sequence[Measurement]) -> list[LensRow]:
    """A row for each camera. Harmed are pictures that the service makes worse by more than a tenth and 0.1 px."""
    rows = []
    for camera, own in groups(measurements).items():
        nothing, estimated, applied = (_all(own, name) for name in ("lens_nothing_px", "lens_px", "applied_px"))
        harmed = applied > _HARM_SHARE * nothing + _HARM_PX
        rows.append(LensRow(camera, len(own), nothing.mean(), estimated.mean(), applied.mean(), float(harmed.mean())))
    return rows


def removed_share(rows: Sequence[LensRow], *, applied: bool = True) -> float:
    """Mean over the cameras that have a distortion of the share of it that is removed."""
    shares = [row.removed_as_applied if applied else row.removed for row in rows if not is_straight(row.camera)]
    return float(np.mean(shares))


def lens_table(measurements: Sequence[Measurement]) -> str:
    rows = lens_rows(measurements)
    lines = _head("camera", "n", "doing nothing", "estimated", "as applied", "removed", "removed as applied", "harmed")
    for row in rows:
        shares = ("-", "-") if is_straight(row.camera) else (_percent(row.removed), _percent(row.removed_as_applied))
        lines.append(
            _row(row.camera, row.pictures, row.nothing_px, row.estimated_px, row.applied_px, *shares, row.harmed)
        )
    lines += [
        "",
        f"Of the distortion {_percent(removed_share(rows, applied=False))} is removed on average over the cameras that"
        f" have one, {_percent(removed_share(rows))} as applied.",
    ]
    return "\n".join(lines) + "\n"


def oblique_ratio(measurements: Sequence[Measurement], *, applied: bool = False) -> float:
    """Mean error of oblique pictures over that of their upright twins, up to a homography, bent families alone."""
    name = "applied_px" if applied else "lens_px"
    means = []
    for side in (OBLIQUE, UPRIGHT):
        own = [m for m in measurements if m.group.startswith(f"{side} ") and not m.group.endswith(" none")]
        means.append(_all(own, name).mean())
    return float(means[0] / means[1])


def oblique_table(measurements: Sequence[Measurement]) -> str:
    found = groups(measurements)
    lines = _head(
        "family",
        "n",
        "upright: nothing",
        "estimated",
        "median",
        "applied",
        "oblique: nothing",
        "estimated",
        "median",
        "applied",
        "ratio",
    )
    for family in dict.fromkeys(group.split(" ", 1)[1] for group in found):
        cells: list[float] = []
        for side in (UPRIGHT, OBLIQUE):
            own = found[f"{side} {family}"]
            lens = _all(own, "lens_px")
            cells += [
                _all(own, "lens_nothing_px").mean(),
                lens.mean(),
                float(np.median(lens)),
                _all(own, "applied_px").mean(),
            ]
        ratio = f"{cells[5] / cells[1]:.2f}" if cells[1] > 0.05 else "-"
        lines.append(_row(family, len(found[f"{UPRIGHT} {family}"]), *cells, ratio))
    lines += [
        "",
        f"Oblique over upright, bent families together: {oblique_ratio(measurements):.2f} as estimated,"
        f" {oblique_ratio(measurements, applied=True):.2f} as applied.",
    ]
    return "\n".join(lines) + "\n"


def family_table(measurements: Sequence[Measurement]) -> str:
    """Both gauges and the quality of the pictures, by family."""
    lines = _head(
        "family",
        "n",
        "all: nothing",
        "all",
        "median",
        "lens: nothing",
        "lens",
        "median",
        "p90",
        "applied",
        "made worse",
        "corrected",
        "SSIM: nothing",
        "SSIM",
        "MSE: nothing",
        "MSE",
    )
    found = groups(measurements)
    for family, own in found.items():
        error, nothing, lens, applied = (
            _all(own, name) for name in ("error_px", "lens_nothing_px", "lens_px", "applied_px")
        )
        quality = ["-"] * 4
        if own[0].ssim is not None:
            quality = [f"{_all(own, 'ssim_nothing').mean():.3f}", f"{_all(own, 'ssim').mean():.3f}"]
            quality += [f"{_all(own, 'mse_nothing').mean():.0f}", f"{_all(own, 'mse').mean():.0f}"]
        lines.append(
            _row(
                family,
                len(own),
                _all(own, "nothing_px").mean(),
                error.mean(),
                float(np.median(error)),
                nothing.mean(),
                lens.mean(),
                float(np.median(lens)),
                float(np.percentile(lens, 90)),
                applied.mean(),
                float((applied > nothing + _MUCH_WORSE_PX).mean()),
                float(_all(own, "applies").mean()),
                *quality,
            )
        )
    if all(family in found for family in SIX):
        nothing_px, error_px = (
            np.mean([_all(found[family], name).mean() for family in SIX]) for name in ("nothing_px", "error_px")
        )
        lines += ["", f"Everything, mean of the six families: {nothing_px:.2f} px of doing nothing, {error_px:.2f} px."]
    return "\n".join(lines) + "\n"


def quality_table(by_method: Mapping[str, Sequence[Measurement]]) -> str:
    """The paper's Table 1: SSIM and MSE over a hundred pictures, each under one of the six families, `correct=all`."""
    lines = _head("method", "n", "SSIM", "MSE", "EPE px", "estimate, median ms")
    for method, own in by_method.items():
        lines.append(
            _row(
                method,
                len(own),
                f"{_all(own, 'ssim').mean():.3f}",
                f"{_all(own, 'mse').mean():.0f}",
                _all(own, "error_px").mean(),
                f"{1000 * float(np.median(_all(own, 'seconds'))):.1f}",
            )
        )
    first = next(iter(by_method.values()))
    similarity, squared = _all(first, "ssim_nothing").mean(), _all(first, "mse_nothing").mean()
    lines += ["", f"Doing nothing: SSIM {similarity:.3f}, MSE {squared:.0f}. {_UNPUBLISHED}"]
    return "\n".join(lines) + "\n"


def no_harm_table(measurements: Sequence[Measurement], bent: Sequence[Measurement] = ()) -> str:
    """Undistorted photographs, by threshold; `bent` ones of the synthetic suite say what the threshold costs."""
    lines = _head(
        "threshold",
        "moved by less than 0.5 px",
        "mean px",
        "p95 px",
        f"bent by more than {BENT_PX:g} px, corrected",
        "error of the bent",
        "of doing nothing",
    )
    for threshold in (None, 0.0, 0.3, 0.5, 0.6, 0.7, 0.8, 0.9):
        harm, share, error, nothing = harm_at(measurements, bent, threshold)
        label = "of the card" if threshold is None else f"{threshold:g}"
        lines.append(
            _row(
                label,
                float((harm < MOVED_PX).mean()),
                harm.mean(),
                float(np.percentile(harm, 95)),
                share,
                error,
                nothing,
            )
        )
    return "\n".join(lines) + "\n"


def harm_at(
    undistorted: Sequence[Measurement], bent: Sequence[Measurement], threshold: float | None
) -> tuple[np.typing.NDArray[np.float64], float, float, float]:
    """At a confidence (None: as applied): displacements of undistorted pictures; of the pictures that are bent by more
    than BENT_PX the share that is corrected, their mean error then, and that of doing nothing."""

    strong = [m for m in bent if m.lens_nothing_px > BENT_PX]
    nothing = _all(strong, "lens_nothing_px")
    if threshold is None:
        moved, error = _all(undistorted, "applied_moved_px"), _all(strong, "applied_px")
        corrected = _all(strong, "applies") > 0
    else:
        corrected = _all(strong, "confidence") >= threshold
        error = np.where(corrected, _all(strong, "lens_px"), nothing)
        moved = np.where(_all(undistorted, "confidence") >= threshold, _all(undistorted, "moved_px"), 0.0)
    if not strong:
        return moved, float("nan"), float("nan"), float("nan")
    return moved, float(corrected.mean()), float(error.mean()), float(nothing.mean())


def _all(measurements: Sequence[Measurement], name: str) -> np.typing.NDArray[np.float64]:
    return np.array([getattr(m, name) for m in measurements], np.float64)


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


def _head(*names: str) -> list[str]:
    return ["| " + " | ".join(names) + " |", "|" + "---|" * len(names)]


def _row(*cells: object) -> str:
    return "| " + " | ".join(f"{c:.2f}" if isinstance(c, float) else str(c) for c in cells) + " |"
