from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from unbend_service.cli import app


def test_a_folder_without_photographs_is_said_at_once(tmp_path: Path) -> None:
    """No page is opened that would have nothing to show."""
    (tmp_path / "notes.txt").write_text("nothing")
    result = CliRunner().invoke(app, ["annotate", str(tmp_path), "--no-open"])
    assert result.exit_code == 1
    assert "has no photographs" in result.stderr


@pytest.mark.parametrize("what", ["missing", "file"])
def test_what_is_no_folder_is_said_in_a_sentence(tmp_path: Path, what: str) -> None:
    """Without a traceback."""
    (tmp_path / "file").write_text("x")
    result = CliRunner().invoke(app, ["annotate", str(tmp_path / what), "--no-open"])
    assert result.exit_code == 1
    assert str(tmp_path / what) in result.stderr
