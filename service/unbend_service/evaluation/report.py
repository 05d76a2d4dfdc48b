"""What an evaluation leaves behind: a page of tables, and every measurement as JSON."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from unbend_service.evaluation import suites, tables
from unbend_service.evaluation.figures import Gallery, reliability_plot, threshold_plot
from unbend_service.evaluation.lenses import is_straight
from unbend_service.evaluation.one_camera import camera_rows, camera_table
from unbend_service.evaluation.suites import Measurement

REPORT, RESULTS = "report.md", "results.json"
_TITLES = {
    suites.SYNTHETIC: "Six families, none and mixed",
    suites.NO_HARM: "Undistorted photographs",
    suites.REAL_LENSES: "Real lenses",
    suites.DRAWN_LENSES: "The same lenses over drawn scenes",
    suites.OBLIQUE: "Oblique and upright views",
    suites.ONE_CAMERA: "Ten pictures of one camera",
    suites.TABLE_ONE: "The paper's first table",
}


@dataclass
class Evaluation:
    """Suite -> method -> measurements, and what was shown to whom.

    Attributes:
        photographs: how many, and of which folder.
        models: name -> SHA-256 of the weights.
        gallery: pictures of the first model's best and worst answers.
        figures: file names of the figures, once written.
    """

    photographs: str
    models: dict[str, str]
    measured: dict[str, dict[str, list[Measurement]]] = field(default_factory=dict)
    gallery: Gallery | None = None
    figures: list[str] = field(default_factory=list)

    def markdown(self) -> str:
        """The whole page."""
        parts = [
            "# Evaluation\n",
            f"{self.photographs}. End-point errors of the backward map in pixels of a picture whose long side is 256:"
            " of everything (`all`, `correct=all`), and up to the best homography (`lens`, `correct=nonlinear`)."
            " *Applied* is what the service does at the confidence that the model's card advises.\n",
        ]
        for suite, by_method in self.measured.items():
            parts.append(f"## {_TITLES[suite]}\n")
            if suite == suites.TABLE_ONE:
                parts.append(tables.quality_table(by_method))
                continue
            for method, measurements in by_method.items():
                parts.append(f"### {method}\n\n{self._table(suite, method, measurements)}")
        parts += [f"![{name.split('.')[0]}]({name})\n" for name in self.figures]
        if self.models:
            parts.append("## Weights\n\n| model | SHA-256 |\n|---|---|")
            parts[-1] += "".join(f"\n| {name} | `{digest}` |" for name, digest in self.models.items()) + "\n"
        return "\n".join(parts)

    def _table(self, suite: str, method: str, measurements: list[Measurement]) -> str:
        if suite in (suites.REAL_LENSES, suites.DRAWN_LENSES):
            return tables.lens_table(measurements)
        if suite == suites.OBLIQUE:
            return tables.oblique_table(measurements)
        if suite == suites.ONE_CAMERA:
            return camera_table(measurements)
        if suite == suites.NO_HARM:
            bent = self.measured.get(suites.SYNTHETIC, {}).get(method, [])
            return tables.no_harm_table(measurements, bent)
        return tables.family_table(measurements)

    def _draw(self, folder: Path) -> None:
        """Curves of the models (peers have no confidence), and the sheets."""
        self.figures = []
        synthetic, undistorted = (
            {name: own for name, own in self.measured.get(suite, {}).items() if name in self.models}
            for suite in (suites.SYNTHETIC, suites.NO_HARM)
        )
        curves = {}
        if synthetic and undistorted:
            both = {name: [*synthetic[name], *undistorted[name]] for name in synthetic}
            curves = {
                "reliability.svg": reliability_plot(both),
                "threshold.svg": threshold_plot(undistorted, synthetic),
            }
        for name, text in curves.items():
            (folder / name).write_text(text, encoding="utf-8")
            self.figures.append(name)
        if self.gallery is not None:
            self.figures += [f"{name}.jpg" for name in self.gallery.write(folder)]

    def summary(self) -> dict[str, Any]:
        """Method -> the handful of figures that a target can be set for."""
        found: dict[str, dict[str, float]] = {}
        for suite, by_method in self.measured.items():
            for method, measurements in by_method.items():
                found.setdefault(method, {}).update(_figures(suite, measurements))
        return found

    def write(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._draw(folder)
        (folder / REPORT).write_text(self.markdown(), encoding="utf-8")
        results = {
            "photographs": self.photographs,
            "models": self.models,
            "summary": self.summary(),
            "measurements": {
                suite: {method: [asdict(m) for m in own] for method, own in by_method.items()}
                for suite, by_method in self.measured.items()
            },
        }
        (folder / RESULTS).write_text(json.dumps(results, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _figures(suite: str, measurements: list[Measurement]) -> dict[str, float]:
    if suite in (suites.REAL_LENSES, suites.DRAWN_LENSES):
        name = "real_lenses" if suite == suites.REAL_LENSES else "drawn_lenses"
        rows = tables.lens_rows(measurements)
        straight = [row for row in rows if is_straight(row.camera)]
        figures = {
            f"{name}_removed": tables.removed_share(rows, applied=False),
            f"{name}_removed_as_applied": tables.removed_share(rows),
            f"{name}_harmed": float(np.mean([row.harmed for row in rows])),
        }
        if straight:
            figures[f"{name}_straight_px"] = float(np.mean([row.applied_px for row in straight]))
        return figures
    if suite == suites.OBLIQUE:
        return {
            "oblique_ratio": tables.oblique_ratio(measurements),
            "oblique_ratio_as_applied": tables.oblique_ratio(measurements, applied=True),
        }
    if suite == suites.NO_HARM:
        moved, _, _, _ = tables.harm_at(measurements, [], None)
        return {
            "undistorted_unmoved": float((moved < tables.MOVED_PX).mean()),
            "undistorted_p95_px": float(np.percentile(moved, 95)),
        }
    if suite == suites.TABLE_ONE:
        return {}
    if suite == suites.ONE_CAMERA:
        _, _, alone, fused = zip(*camera_rows(measurements), strict=True)
        return {"one_camera_ratio": float(np.mean(fused) / np.mean(alone))}
    figures = {}
    for family, own in tables.groups(measurements).items():
        figures[f"all_{family}_px"] = float(np.mean([m.error_px for m in own]))
        figures[f"lens_{family}_px"] = float(np.mean([m.lens_px for m in own]))
    return figures
