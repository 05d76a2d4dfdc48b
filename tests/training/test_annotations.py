from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from training.annotations import read_annotation, read_annotations
from unbend_service.domain.errors import InvalidGuides
from unbend_service.domain.grid import Grid


def write(folder: Path, name: str, points: int = 9, noise: float = 0.0) -> Path:
    along, rng = np.linspace(-0.9, 0.9, points), np.random.default_rng(1)
    value: dict[str, Any] = {"version": 1, "image": name, "width": 800, "height": 600, "rows": [], "columns": []}
    for family in ("rows", "columns"):
        for at in (-0.6, 0.5):
            across = at * (1 - 0.12 * along**2) + 0.02 * along**3 + rng.normal(0, noise, points)
            both = [along, across] if family == "rows" else [across, along]
            value[family].append({"points": np.stack(both, axis=1).tolist(), "coefficients": []})
    path = folder / f"{name}.unbend.json"
    path.write_text(json.dumps(value))
    return path


def test_an_annotation_becomes_the_sixteen_numbers_of_the_paper(tmp_path: Path) -> None:
    """Cubic least squares; the guides span a grid."""
    one = read_annotation(write(tmp_path, "a.jpg"))
    assert one.picture == tmp_path / "a.jpg"
    assert (one.width, one.height) == (800, 600)
    expected = [-0.6, 0, 0.072, 0.02, 0.5, 0, -0.06, 0.02]
    assert one.coefficients() == pytest.approx([*expected, *expected], abs=1e-9)
    assert one.residual < 1e-9
    assert Grid.from_map(one.guides).is_unfolded


def test_the_residual_says_how_steady_the_hand_was(tmp_path: Path) -> None:
    """Root mean square over all points, a little less than the noise because the curve follows it."""
    one = read_annotation(write(tmp_path, "a.jpg", points=60, noise=0.01))
    assert one.residual == pytest.approx(0.01, rel=0.2)


def test_unfinished_and_foreign_files_are_passed_over(tmp_path: Path) -> None:
    """A folder in the middle of the work can be trained on; one file read by itself says what is wrong."""
    write(tmp_path, "b.jpg")
    (tmp_path / "more").mkdir()
    write(tmp_path / "more", "a.jpg")
    unfinished = write(tmp_path, "c.jpg", points=3)
    broken = tmp_path / "d.jpg.unbend.json"
    broken.write_text("{")
    assert [one.picture.name for one in read_annotations(tmp_path)] == ["b.jpg", "a.jpg"]
    with pytest.raises(InvalidGuides, match="not complete"):
        read_annotation(unfinished)
    with pytest.raises(InvalidGuides, match="is not JSON"):
        read_annotation(broken)
