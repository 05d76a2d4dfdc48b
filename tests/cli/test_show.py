from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from tests.fakes import barrel_guides
from unbend_service.cli import app
from unbend_service.domain.grid import Grid
from unbend_service.domain.records import GridRecord


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("UNBEND_RENDERER", "cpu")
    y, x = np.mgrid[0:240, 0:320]
    squares = np.repeat(((x // 20 + y // 20) % 2 * 200 + 20)[..., None], 3, 2).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "in.png"), squares)
    record = GridRecord(Grid.from_map(barrel_guides(), 33, 33), barrel_guides())
    (tmp_path / "grid.json").write_text(json.dumps(record.to_dict()))
    return tmp_path


def run(folder: Path, *arguments: str, code: int = 0) -> str:
    source, grid = str(folder / "in.png"), str(folder / "grid.json")
    result = CliRunner().invoke(app, ["show", source, *arguments, "--grid", grid])
    assert result.exit_code == code, result.output
    return result.output


@pytest.mark.parametrize("what", ["guides", "grid", "grids", "displacement", "magnitude", "sheet"])
def test_each_figure_is_a_picture(folder: Path, what: str) -> None:
    """Every figure is drawn, differs from the photograph, and is large enough to hold it."""
    run(folder, str(folder / "out.png"), "--what", what)
    figure = cv2.imread(str(folder / "out.png"))
    assert figure.shape[0] >= 240
    assert figure.shape[1] >= 320
    assert np.abs(figure[:240, :320].astype(int) - cv2.imread(str(folder / "in.png"))).max() > 20 or what == "sheet"


SVG = "{http://www.w3.org/2000/svg}"


@pytest.mark.parametrize(
    ("what", "pictures", "lines"),
    [
        ("guides", 1, 8),
        ("grid", 1, 30),
        ("grids", 2, 60),
        ("displacement", 1, 150),
        ("magnitude", 2, 6),
        ("sheet", 4, 38),
    ],
)
def test_svg_holds_lines_that_can_be_scaled(folder: Path, what: str, pictures: int, lines: int) -> None:
    """Photographs are embedded; curves, arrows and words are vectors."""
    run(folder, str(folder / "out.svg"), "--what", what)
    tree = ElementTree.parse(folder / "out.svg")
    assert len(tree.findall(f".//{SVG}image")) == pictures
    assert len(tree.findall(f".//{SVG}polyline")) >= lines
    words = [element.text for element in tree.findall(f".//{SVG}text")]
    expected = {
        "displacement": "px",
        "magnitude": "px",
        "sheet": "after",
        "grids": "straightened",
    }.get(what)
    assert expected is None or any(expected in (word or "") for word in words), words


@pytest.mark.parametrize("what", ["sheet", "displacement"])
def test_a_browser_draws_the_svg_as_the_png(folder: Path, what: str) -> None:
    """Chromium, shown the SVG, gives the picture of the PNG to within its smoothing of lines and its own letters."""
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("no chromium on this machine (Debian: apt-get install chromium)")
    noise = cv2.GaussianBlur(np.random.default_rng(1).normal(size=(480, 640, 3)), (0, 0), 8) * 900 + 128
    cv2.imwrite(str(folder / "in.png"), np.clip(noise, 0, 255))
    run(folder, str(folder / "out.png"), "--what", what)
    run(folder, str(folder / "out.svg"), "--what", what)
    expected = cv2.imread(str(folder / "out.png"))
    size = f"--window-size={expected.shape[1]},{expected.shape[0] + 200}"
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", size]
    where = [f"--screenshot={folder / 'shot.png'}", (folder / "out.svg").as_uri()]
    subprocess.run([chromium, *flags, *where], check=True, timeout=60, capture_output=True)
    drawn = cv2.imread(str(folder / "shot.png"))[: expected.shape[0], : expected.shape[1]]
    coarse = [cv2.resize(one, None, fx=0.125, fy=0.125, interpolation=cv2.INTER_AREA) for one in (drawn, expected)]
    assert np.abs(coarse[0].astype(int) - coarse[1]).mean() < 4


def test_mistakes_are_sentences(folder: Path) -> None:
    (folder / "taken.png").write_bytes(b"mine")
    assert "--overwrite" in run(folder, str(folder / "taken.png"), code=2)
    assert ".png" in run(folder, str(folder / "out.gif"), code=3)
