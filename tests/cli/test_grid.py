from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.fakes import RECORD
from unbend_service.cli import app
from unbend_service.domain.records import GridRecord


def run(*arguments: object, code: int = 0) -> str:
    result = CliRunner().invoke(app, ["grid", *map(str, arguments)])
    assert result.exit_code == code, result.output
    return result.output


def test_a_grid_file_is_described(record_file: Path) -> None:
    assert RECORD.id in run("show", record_file)
    assert json.loads(run("show", record_file, "--json"))["grid"] == RECORD.grid.to_dict()


def test_a_grid_goes_out_and_comes_back(record_file: Path, tmp_path: Path) -> None:
    """The suffix chooses the format; a redistortion imported as one is the correction again."""
    stmap, again = tmp_path / "re.tiff", tmp_path / "again.json"
    run("export", record_file, stmap, "--width", 320, "--height", 240, "--direction", "redistort")
    run("import", stmap, again, "--direction", "redistort", "--points", 33)
    read = GridRecord.from_dict(json.loads(again.read_text())).grid
    assert np.abs(read.source - RECORD.grid.source)[1:-1, 1:-1].max() * 160 < 0.1


def test_the_inverse_is_written_with_its_error(record_file: Path, tmp_path: Path) -> None:
    """There and back is within a tenth of a pixel, and the command says so."""
    summary = json.loads(run("invert", record_file, tmp_path / "inverse.json", "--json"))
    assert summary["round_trip_error_px_at_1024"] < 0.1
    assert GridRecord.from_dict(json.loads((tmp_path / "inverse.json").read_text())).grid.is_unfolded


def test_a_grid_is_kept_in_the_private_store(
    record_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the sqlite store an imported grid is there for the next command, by its id."""
    monkeypatch.setenv("UNBEND_GRID_STORE", "sqlite")
    monkeypatch.setenv("UNBEND_GRID_STORE_PATH", str(tmp_path / "grids.sqlite3"))
    grid_id = json.loads(run("import", record_file, "--format", "json", "--json"))["grid_id"]
    assert grid_id in run("show", grid_id)


def test_mistakes_are_sentences(record_file: Path, tmp_path: Path) -> None:
    """Nothing is overwritten unasked; sizes, formats and ids that are missing are named."""
    taken = tmp_path / "taken.npz"
    taken.write_bytes(b"mine")
    assert "--overwrite" in run("export", record_file, taken, "--width", 8, "--height", 8, code=2)
    assert taken.read_bytes() == b"mine"
    assert "width and height" in run("export", record_file, tmp_path / "x.npz", code=3)
    assert ".exr" in run("export", record_file, tmp_path / "x.dng", code=3)
    run("show", "gnope", code=1)
    run("show", tmp_path / "none.json", code=1)
    run("show", "gnope", "--server", "127.0.0.1:1", code=1)
