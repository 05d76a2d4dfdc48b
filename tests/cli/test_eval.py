from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from typer.testing import CliRunner

from unbend_service.cli import app


def drawn_street(path: Path, seed: int) -> None:
    """Straight edges in several directions."""
    rng = np.random.default_rng(seed)
    picture = np.full((384, 512, 3), 200, np.uint8)
    for _ in range(40):
        x, y, width, height = rng.integers(0, 400), rng.integers(0, 300), *rng.integers(20, 160, 2)
        cv2.rectangle(picture, (x, y), (x + width, y + height), rng.integers(0, 255, 3).tolist(), -1)
    cv2.imwrite(str(path), cv2.GaussianBlur(picture, (0, 0), 0.8))


def test_a_model_is_measured(tmp_path: Path) -> None:
    """A page for people, all figures for programs; without torch and without a running service."""
    (tmp_path / "photos").mkdir()
    for seed in range(2):
        drawn_street(tmp_path / "photos" / f"{seed}.png", seed)
    command = ["eval", "--photos", str(tmp_path / "photos"), "--model", "lineset", "--per-camera", "1"]
    command += [
        "--suite",
        "synthetic,no-harm,real-lenses,drawn-lenses",
        "--scenes",
        str(tmp_path / "photos"),
        "--families",
        "barrel,none",
        "--chessboards",
        str(tmp_path),
        "--out",
        str(tmp_path / "out"),
    ]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    page = (tmp_path / "out" / "report.md").read_text()
    assert "### lineset" in page
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    summary = results["summary"]["lineset"]
    bent = [m for m in results["measurements"]["synthetic"]["lineset"] if m["group"] == "barrel"]
    assert summary["lens_barrel_px"] < 0.5 * sum(m["lens_nothing_px"] for m in bent) / len(bent)
    assert summary["real_lenses_removed"] > 0.3
    assert summary["drawn_lenses_straight_px"] < 0.5
    assert {"report.md", "results.json", "reliability.svg", "threshold.svg"} <= {
        path.name for path in (tmp_path / "out").iterdir()
    }


def test_an_unknown_suite_is_named(tmp_path: Path) -> None:
    """With what is allowed."""
    result = CliRunner().invoke(app, ["eval", "--photos", str(tmp_path), "--suite", "speed"])
    assert result.exit_code == 3
    assert "real-lenses" in result.stderr


def test_lenses_over_drawn_scenes_need_scenes(tmp_path: Path) -> None:
    """They are no photographs, so they are named apart."""
    drawn_street(tmp_path / "0.png", 0)
    result = CliRunner().invoke(app, ["eval", "--photos", str(tmp_path), "--suite", "drawn-lenses"])
    assert result.exit_code == 3
    assert "--scenes" in result.stderr
