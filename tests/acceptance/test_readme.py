"""The README and docs/*.md: what they show works as it stands, and what they link to is there."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from tests.acceptance.conftest import Server
from unbend_service.settings import Settings

ROOT = Path(__file__).parent.parent.parent
README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "docs").glob("*.md"))]


def snippets(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)


def all_snippets(language: str) -> list[object]:
    """Those of every page, named so that a failure says where to look."""
    found = [(page.name, number, text) for page in PAGES for number, text in enumerate(snippets(page, language), 1)]
    return [pytest.param(text, id=f"{name}-{number}") for name, number, text in found if not text.startswith("make")]


def test_the_first_two_commands_are_make_serve_and_make_test() -> None:
    commands = re.findall(r"^(make \w+)", snippets(README, "sh")[0], re.MULTILINE)
    assert commands == ["make serve", "make test"]


def test_the_configuration_tables_are_those_of_the_settings() -> None:
    sys.path.insert(0, str(ROOT / "docs"))
    try:
        from settings import PAGES, with_table
    finally:
        sys.path.pop(0)
    for page in PAGES:
        assert with_table(page.read_text()) == page.read_text(), f"run `make docs`: {page.name}"


def test_every_promise_names_what_shows_it() -> None:
    (table,) = re.findall(r"^\| promise \| shown by \|\n\|---\|---\|\n((?:\|.*\n)+)", README.read_text(), re.MULTILINE)
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for row in table.splitlines():
        named = re.findall(r"`(make [a-z-]+|tests/[\w/.]+)`", row.split(" | ")[-1])
        assert named, row
        for one in named:
            assert one.removeprefix("make ") in targets or (ROOT / one).exists(), one


@pytest.mark.parametrize("page", [README, ROOT / "docs/accuracy.md"], ids=lambda page: page.name)
def test_the_figures_are_those_of_the_model_that_is_used_by_default(page: Path) -> None:
    (figures,) = re.findall(r"^<!-- figures:.*?^<!-- /figures -->", page.read_text(), re.MULTILINE | re.DOTALL)
    model = Settings.model_fields["model"].default
    assert re.search(rf"\b{model}\b", figures), f"{page.name} tells the figures of another model than {model!r}"
    assert "doing nothing" in figures


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_into_the_repository_leads_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\((?!http)([^)#]+)", page.read_text()):
        assert (page.parent / target).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_pictures_say_in_words_what_they_show(page: Path) -> None:
    for words, target in re.findall(r"!\[([^\]]*)\]\(([^)]+)\)", page.read_text()):
        assert len(words) > 10, target


def test_no_picture_is_large() -> None:
    for picture in (ROOT / "docs/pictures").iterdir():
        assert picture.stat().st_size < 200_000, picture.name


def lay_out(folder: Path) -> None:
    """What the snippets find beside them: photo.jpg, photographs/, ride.mp4 and a camera's calibration.yml."""
    rng = np.random.default_rng(3)
    picture = cv2.resize(rng.integers(0, 255, (12, 16, 3), dtype=np.uint8), (640, 480))
    cv2.imwrite(str(folder / "photo.jpg"), picture)
    (folder / "photographs").mkdir()
    cv2.imwrite(str(folder / "photographs/first.jpg"), picture)
    with av.open(str(folder / "ride.mp4"), "w") as film:
        stream = film.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt = 640, 480, "yuv420p"
        for _ in range(8):
            film.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        film.mux(stream.encode())
    calibration = cv2.FileStorage(str(folder / "calibration.yml"), cv2.FILE_STORAGE_WRITE)
    calibration.write("image_width", 640)
    calibration.write("image_height", 480)
    calibration.write("camera_matrix", np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]))
    calibration.write("distortion_coefficients", np.array([[-0.2, 0.03, 0, 0, 0]]))
    calibration.release()


@pytest.mark.parametrize("snippet", all_snippets("sh"))
def test_shell_snippets_work_as_they_stand(server: Server, tmp_path: Path, snippet: str) -> None:
    lay_out(tmp_path)
    ready = snippet.replace("localhost:8080", server.http).replace(".venv/bin/unbend", f"{sys.executable} -m unbend")
    ready = ready.replace("python3 -c", f"{sys.executable} -c").replace("curl -sS", "curl -sS --fail-with-body")
    # the doctor is to look at free ports, whatever else runs on this machine
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = os.environ | {"UNBEND_HTTP_PORT": "0", "UNBEND_GRPC_PORT": "0", "PATH": path}
    environment |= {"UNBEND_WORKERS": "1", "UNBEND_DECODERS": "1"}  # commands start services of their own
    subprocess.run(["bash", "-euc", ready], cwd=tmp_path, env=environment, check=True, timeout=120)
    for name in re.findall(r"-o ([\w.]+)", snippet):
        assert (tmp_path / name).stat().st_size > 0
    for name in re.findall(r"-o ([\w]+\.(?:jpg|png))", snippet):
        assert cv2.imread(str(tmp_path / name)) is not None


@pytest.mark.parametrize("snippet", all_snippets("python"))
def test_python_snippets_work_as_they_stand(server: Server, tmp_path: Path, snippet: str) -> None:
    ready = snippet.replace("127.0.0.1:50051", server.grpc)
    command = [sys.executable, "-W", "error::DeprecationWarning:__main__", "-c", ready]
    subprocess.run(command, cwd=tmp_path, check=True, timeout=120)


def test_the_readme_shows_what_comes_back(server: Server) -> None:
    (snippet,) = snippets(README, "python")
    ready = snippet.replace("127.0.0.1:50051", server.grpc)
    result = subprocess.run([sys.executable, "-c", ready], check=True, timeout=120, capture_output=True, text=True)
    assert result.stdout.count("(480, 640, 3)") == 11
