from __future__ import annotations

import json
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from unbend_service.adapters.annotations.folder import AnnotationFolder
from unbend_service.adapters.metrics.prometheus import PrometheusMeter
from unbend_service.transport.rest.annotation import create_annotation_app

CURVE = {"points": [[-0.5, 0.1], [0, 0.1], [0.25, 0.1], [0.5, 0.1]]}
UPRIGHT = {"points": [[0.1, -0.5], [0.1, 0], [0.1, 0.25], [0.1, 0.5]]}
BODY = {"width": 640, "height": 480, "rows": [CURVE, CURVE], "columns": [UPRIGHT, UPRIGHT]}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    inside = tmp_path / "pictures"
    inside.mkdir()
    for name in ("one & two.jpg", "three.png"):
        (inside / name).write_bytes(name.encode())
    (tmp_path / "secret.jpg").write_bytes(b"secret")
    return inside


@pytest.fixture
async def pages(folder: Path) -> AsyncIterator[httpx.AsyncClient]:
    app = create_annotation_app(AnnotationFolder(folder), PrometheusMeter())
    async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://127.0.0.1:1234") as client:
        yield client


async def test_the_page_finds_its_pictures_and_what_is_done(pages: httpx.AsyncClient, folder: Path) -> None:
    """Which pictures there are, their bytes, and that nothing was said of them yet."""
    assert (await pages.get("/")).text.startswith("<!doctype html>")
    overview = (await pages.get("/annotation")).json()
    assert overview["title"] == folder.name
    assert [one["name"] for one in overview["pictures"]] == ["one & two.jpg", "three.png"]
    picture = await pages.get("/annotation/pictures/one%20%26%20two.jpg")
    assert (picture.content, picture.headers["content-type"]) == (b"one & two.jpg", "image/jpeg")
    assert (await pages.get("/annotation/pictures/three.png")).headers["content-type"] == "image/png"
    assert (await pages.get("/annotation/curves/three.png")).json() is None


async def test_what_is_put_is_kept_beside_the_picture(pages: httpx.AsyncClient, folder: Path) -> None:
    """Coefficients are the service's own; the overview knows what is complete."""
    kept = await pages.put("/annotation/curves/three.png", json=BODY)
    assert kept.json()["complete"] is True
    stored = json.loads((folder / "three.png.unbend.json").read_bytes())
    assert stored["image"] == "three.png"
    assert stored["rows"][0]["coefficients"] == pytest.approx([0.1, 0, 0, 0], abs=1e-9)
    assert (await pages.get("/annotation/curves/three.png")).json() == stored
    assert [one["complete"] for one in (await pages.get("/annotation")).json()["pictures"]] == [False, True]


@pytest.mark.parametrize("name", ["..%2Fsecret.jpg", "%2Fetc%2Fpasswd", "..%5Csecret.jpg", "secret.jpg", "%2e%2e"])
async def test_nothing_outside_the_folder_is_read_or_written(pages: httpx.AsyncClient, folder: Path, name: str) -> None:
    """Whatever a path says."""
    for answer in (
        await pages.get(f"/annotation/pictures/{name}"),
        await pages.get(f"/annotation/curves/{name}"),
        await pages.put(f"/annotation/curves/{name}", json=BODY),
    ):
        assert answer.status_code == 404
    assert sorted(path.name for path in folder.parent.rglob("*.json")) == []


@pytest.mark.parametrize("host", ["evil.example", "evil.example:1234", "127.0.0.1.evil.example"])
async def test_a_page_of_another_site_gets_nothing(pages: httpx.AsyncClient, host: str) -> None:
    """A name that somebody pointed at this machine is not this machine's."""
    answer = await pages.get("/annotation", headers={"Host": host})
    assert answer.status_code == 400


@pytest.mark.parametrize(
    ("body", "status"),
    [(b"{", 422), (b"[]", 422), (b"{}", 422), (json.dumps({**BODY, "rows": []}).encode(), 422), (b" " * 2**21, 413)],
)
async def test_what_is_no_annotation_is_refused_with_a_sentence(
    pages: httpx.AsyncClient, folder: Path, body: bytes, status: int
) -> None:
    """And nothing is written."""
    answer = await pages.put("/annotation/curves/three.png", content=body)
    problem: dict[str, Any] = answer.json()
    assert answer.status_code == status
    assert problem["detail"].endswith(".")
    assert not (folder / "three.png.unbend.json").exists()
