from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.domain.lenses import BARREL, radial
from unbend_service.domain.grid import Grid
from unbend_service.domain.records import GridRecord


@pytest.fixture(autouse=True)
def small_services(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands start services of their own, dozens of them here: each process less is half a second."""
    monkeypatch.setenv("UNBEND_WORKERS", "1")
    monkeypatch.setenv("UNBEND_DECODERS", "1")


@pytest.fixture
def grid_file(tmp_path: Path) -> Path:
    """A barrel as JSON."""
    path = tmp_path / "grid.json"
    path.write_text(json.dumps(GridRecord(Grid.from_map(radial(BARREL), 33, 33)).to_dict()))
    return path


@pytest.fixture
def cpu_renderer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UNBEND_RENDERER", "cpu")
