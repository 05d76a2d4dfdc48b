from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from unbend_service.cli import app


def photograph(path: Path, seed: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    y, x = np.mgrid[0:96, 0:128]
    pixels = np.stack([(x * seed) % 255, (y * 2) % 255, (x // 16 + y // 16) % 2 * 255], -1).astype(np.uint8)
    assert cv2.imwrite(str(path), pixels)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("UNBEND_RENDERER", "cpu")
    for index, name in enumerate(("a.jpg", "b.png", "deep/c.webp", "deep/d.bmp")):
        photograph(tmp_path / "in" / name, index + 1)
    (tmp_path / "in" / "notes.txt").write_text("not a photograph")
    return tmp_path


def run(*arguments: object, code: int = 0) -> str:
    result = CliRunner().invoke(app, ["correct", *map(str, arguments)])
    assert result.exit_code == code, result.output
    return result.output


def written(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def test_a_directory_is_corrected_folder_by_folder(folder: Path) -> None:
    """Every photograph has its result under the same name; bmp becomes png; other files are passed over."""
    summary = json.loads(run(folder / "in", folder / "out", "--workers", 1, "--json"))
    assert written(folder / "out") == {"a.jpg", "b.png", "deep/c.webp", "deep/d.png"}
    assert summary["total"] == 4
    assert summary["corrected"] + summary["left_alone"] == 4
    assert summary["failed"] == {}


def test_a_second_run_does_what_is_left(folder: Path) -> None:
    """Results that are there are neither made again nor touched; --overwrite makes them again."""
    out = folder / "out"
    out.mkdir()
    (out / "a.jpg").write_bytes(b"mine")
    summary = json.loads(run(folder / "in", out, "--workers", 1, "--json"))
    assert summary["skipped"] == 1
    assert (out / "a.jpg").read_bytes() == b"mine"
    assert json.loads(run(folder / "in", out, "--workers", 1, "--json"))["skipped"] == 4
    run(folder / "in" / "*.jpg", out, "--workers", 1, "--overwrite")
    assert (out / "a.jpg").read_bytes() != b"mine"


def test_a_broken_photograph_does_not_keep_the_others(folder: Path) -> None:
    """The summary names it with its fault, and the exit code says that not all went well."""
    (folder / "in" / "broken.jpg").write_bytes(b"\xff\xd8 not much of a jpeg")
    summary = json.loads(run(folder / "in" / "*.*", folder / "out", "--workers", 1, "--json", code=1))
    assert [Path(path).name for path in summary["failed"]] == ["broken.jpg"]
    assert written(folder / "out") == {"a.jpg", "b.png"}


def test_a_pattern_keeps_the_folders_below_its_first_wildcard(folder: Path) -> None:
    run(folder / "in" / "**" / "*.webp", folder / "out", "--workers", 1)
    assert written(folder / "out") == {"deep/c.webp"}


def test_results_inside_the_directory_are_not_corrected_again(folder: Path) -> None:
    """OUT may lie inside IN."""
    run(folder / "in", folder / "in" / "out", "--workers", 1)
    assert json.loads(run(folder / "in", folder / "in" / "out", "--workers", 1, "--json"))["total"] == 4


def test_mistakes_are_sentences(folder: Path) -> None:
    """An empty pattern, a file where a directory must be, two photographs of one result."""
    assert "no photograph" in run(folder / "in" / "*.gif", folder / "out", code=3)
    assert "directory" in run(folder / "in", folder / "in" / "a.jpg", code=3)
    photograph(folder / "in" / "b.bmp", 9)
    assert "both become" in run(folder / "in", folder / "out", code=3)
    assert not (folder / "out").exists()
