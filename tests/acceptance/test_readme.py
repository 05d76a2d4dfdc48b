from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.acceptance.conftest import Server

ROOT = Path(__file__).parent.parent.parent
README = (ROOT / "README.md").read_text()


def snippets(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.MULTILINE | re.DOTALL)


def test_the_first_two_commands_are_make_serve_and_make_test() -> None:
    commands = re.findall(r"^(make \w+)", snippets("sh")[0], re.MULTILINE)
    assert commands == ["make serve", "make test"]


def test_the_configuration_table_is_that_of_the_settings() -> None:
    sys.path.insert(0, str(ROOT / "docs"))
    try:
        from settings import with_table
    finally:
        sys.path.pop(0)
    assert with_table(README) == README, "run `make docs`"


def test_every_link_into_the_repository_leads_somewhere() -> None:
    for target in re.findall(r"\]\((?!http)([^)#]+)", README):
        assert (ROOT / target).exists(), target


@pytest.mark.parametrize("snippet", [s for s in snippets("sh") if not s.startswith("make")])
def test_shell_snippets_work_as_they_stand(server: Server, tmp_path: Path, snippet: str) -> None:
    rng = np.random.default_rng(3)
    picture = cv2.resize(rng.integers(0, 255, (12, 16, 3), dtype=np.uint8), (640, 480))
    cv2.imwrite(str(tmp_path / "photo.jpg"), picture)
    ready = snippet.replace("localhost:8080", server.http).replace(".venv/bin/unbend", f"{sys.executable} -m unbend")
    ready = ready.replace("curl -sS", "curl -sS --fail-with-body")
    subprocess.run(["bash", "-euc", ready], cwd=tmp_path, check=True, timeout=120)
    for name in re.findall(r"-o (\S+)", snippet):
        assert (tmp_path / name).stat().st_size > 0
    for name in re.findall(r"-o (\S+\.(?:jpg|png))", snippet):
        assert cv2.imread(str(tmp_path / name)) is not None


@pytest.mark.parametrize("snippet", snippets("python"))
def test_python_snippets_work_as_they_stand(server: Server, snippet: str) -> None:
    ready = snippet.replace("127.0.0.1:50051", server.grpc)
    result = subprocess.run([sys.executable, "-c", ready], check=True, timeout=120, capture_output=True, text=True)
    assert result.stdout.count("(480, 640, 3)") == 11
