from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from pathlib import Path

import pytest
import structlog
from hypothesis import settings

from benchmarks.companions import Companion, redis_server
from tests.companions import started
from tests.fakes import RECORD

# The time of an example is no property of the code on a shared machine, and a failure must come back on the next run.
settings.register_profile("unbend", deadline=None, derandomize=True, max_examples=40)
settings.load_profile("unbend")


@pytest.fixture(autouse=True)
def logs_as_they_were() -> Iterator[None]:
    """Commands set logging up for their process, which is the tests' own where they are called in process."""
    root = logging.getLogger()
    handlers, level = list(root.handlers), root.level
    yield
    structlog.reset_defaults()
    root.handlers[:] = handlers
    root.setLevel(level)


@pytest.fixture(scope="session")
def redis(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Companion]:
    """A real redis-server for every test that neither pauses nor stops it; tests keep apart by their prefixes."""
    running = started(lambda: redis_server(tmp_path_factory.mktemp("redis")))
    yield running
    running.stop()


@pytest.fixture
def record_file(tmp_path: Path) -> Path:
    """`RECORD` as the file that `unbend grid` reads and writes."""
    path = tmp_path / "grid.json"
    path.write_text(json.dumps(RECORD.to_dict()))
    return path
