"""The training curve as a picture."""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt


def plot_curve(log: Path, picture: Path) -> None:
    """Draws the errors of the progress log (JSON lines) over millions of samples, overall and by kind."""
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    millions = [line["samples"] / 1e6 for line in lines]
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.5))
    left.plot(millions, [line["epe"] for line in lines], label="all")
    left.plot(millions, [line["nonlinear"] for line in lines], label="up to a homography")
    left.plot(millions, [line["nonlinear_median"] for line in lines], label="the same, median")
    for kind in sorted({kind for line in lines for kind in line["by_kind"]}):
        values = [line["by_kind"].get(kind, [float("nan")] * 2)[1] for line in lines]
        right.plot(millions, values, label=kind, linewidth=0.9)
    for axes, title in ((left, "mean first-order EPE, px at 256"), (right, "up to a homography, by kind")):
        axes.set(title=title, xlabel="samples, millions", yscale="log")
        axes.grid(alpha=0.3, which="both")
        axes.legend(fontsize=7, ncols=2)
    figure.tight_layout()
    figure.savefig(picture, dpi=110)
    plt.close(figure)
