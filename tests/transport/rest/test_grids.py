from __future__ import annotations

import io
import json
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from tests.fakes import barrel_guides, draw_through
from unbend_service.domain.frames import BLACK, Frame, PixelFormat
from unbend_service.domain.grid import Grid
from unbend_service.transport.rest.provenance import GridRecordBody

from .conftest import Bench, chequers

GRID = Grid.from_map(barrel_guides(), 9, 9)


def folded() -> Grid:
    source = Grid.identity(9, 9).source.copy()
    source[4, 4] = source[4, 7]
    return Grid(source)


async def test_a_grid_is_stored_fetched_and_forgotten(client: httpx.AsyncClient) -> None:
    """Post computes the id and says where the grid lies; get gives it back to the last bit; delete forgets it."""
    stored = await client.post("/v1/grids", json={"grid": GRID.to_dict()})
    assert stored.status_code == 201
    assert stored.json()["grid_id"] == GRID.id
    location = stored.headers["location"]
    fetched = await client.get(location)
    assert fetched.json() == stored.json()
    assert np.array_equal(Grid.from_dict(fetched.json()["grid"]).source, GRID.source)
    GridRecordBody.model_validate(fetched.json())
    deleted = await client.delete(location)
    assert (deleted.status_code, deleted.content) == (204, b"")
    for response in (await client.get(location), await client.delete(location)):
        assert (response.status_code, response.json()["code"]) == (404, "grid_not_found")


async def test_what_was_fetched_can_be_put_elsewhere(bench: Bench, jpeg: bytes) -> None:
    """An estimate travels whole: fetched from one service, put into another under the same id."""
    record = (await bench.client.post("/v1/estimate", content=jpeg)).json()
    await bench.client.delete(f"/v1/grids/{record['grid_id']}")
    put = await bench.client.put(f"/v1/grids/{record['grid_id']}", json=record)
    assert put.status_code == 200
    assert put.json() == record
    assert (await bench.client.get(f"/v1/grids/{record['grid_id']}")).json() == record


async def test_an_id_that_is_not_of_the_content_conflicts(client: httpx.AsyncClient) -> None:
    """Ids are derived from content; a wrong one is refused with the right one."""
    response = await client.put("/v1/grids/g0123", json={"grid": GRID.to_dict()})
    assert (response.status_code, response.json()["code"]) == (409, "grid_conflict")
    assert GRID.id in response.json()["detail"]


async def test_guides_alone_become_a_grid(client: httpx.AsyncClient) -> None:
    """Guides drawn by hand are spun into their grid here."""
    stored = (await client.post("/v1/grids", json={"guides": barrel_guides().to_dict()})).json()
    np.testing.assert_allclose(
        Grid.from_dict(stored["grid"]).source, Grid.from_map(barrel_guides(), 17, 17).source, atol=1e-6
    )
    assert stored["confidence_kind"] == "given"


def with_source(value: str) -> bytes:
    text = json.dumps({"grid": {"rows": 2, "columns": 2, "source": [["X", -1], [1, -1], [-1, 1], [1, 1]]}})
    return text.replace('"X"', value).encode()


BAD_GRIDS: dict[str, tuple[bytes, str]] = {
    "NaN": (with_source("NaN"), "invalid_grid"),
    "Infinity": (with_source("-Infinity"), "invalid_grid"),
    "overflow": (with_source("1e999"), "invalid_grid"),
    "null": (with_source("null"), "invalid_grid"),
    "text": (with_source('"left"'), "invalid_grid"),
    "far out": (with_source("1e6"), "invalid_grid"),
    "folded": (json.dumps({"grid": folded().to_dict()}).encode(), "folded_grid"),
    "short": (json.dumps({"grid": {"rows": 3, "columns": 3, "source": [[0, 0]]}}).encode(), "invalid_grid"),
    "huge": (json.dumps({"grid": {"rows": 5000, "columns": 5000, "source": []}}).encode(), "invalid_grid"),
    "ragged": (
        json.dumps({"grid": {"rows": 2, "columns": 2, "source": [[0, 0], [1], [1, 1], [0, 1]]}}).encode(),
        "invalid_grid",
    ),
    "no grid": (b"{}", "invalid_grid"),
    "a list": (b"[]", "invalid_grid"),
    "not json": (b"rows: 2", "invalid_grid"),
    "nothing": (b"", "invalid_grid"),
    "deep": (b"[" * 100_000, "invalid_grid"),
    "bad guides": (json.dumps({"guides": {"rows": [], "columns": []}}).encode(), "invalid_guides"),
}


@pytest.mark.parametrize("name", BAD_GRIDS)
@pytest.mark.parametrize("method", ["POST", "PUT"])
async def test_a_bad_grid_is_refused_and_named(client: httpx.AsyncClient, name: str, method: str) -> None:
    """NaN, folds, wrong shapes and broken JSON are each a 422 with their code; nothing of it is stored."""
    body, code = BAD_GRIDS[name]
    path = "/v1/grids" if method == "POST" else "/v1/grids/g1"
    response = await client.request(method, path, content=body)
    assert (response.status_code, response.json()["code"]) == (422, code)
    assert (await client.post("/v1/grids", json={"grid": GRID.to_dict()})).status_code == 201


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("confidence", "nan"),
        ("confidence", 1.5),
        ("confidence", None),
        ("strength", -1),
        ("strength", True),
        ("outcome", "maybe"),
        ("reason", 7),
        ("model", "x" * 200),
        ("model", {"name": "first"}),
        ("confidence_kind", 3),
    ],
)
async def test_a_bad_provenance_is_refused(client: httpx.AsyncClient, field: str, value: object) -> None:
    """What is said of a grid has types and ranges too; what is stored always fits the description of the answer."""
    response = await client.post("/v1/grids", json={"grid": GRID.to_dict(), field: value})
    assert (response.status_code, response.json()["code"]) == (422, "invalid_grid")


async def test_texts_of_a_sender_do_not_break_headers(client: httpx.AsyncClient, jpeg: bytes) -> None:
    """A model name with line breaks or foreign letters is stored, and shown printable in headers."""
    stored = await client.post("/v1/grids", json={"grid": GRID.to_dict(), "model": "a\r\nSet-Cookie: x=ü"})
    grid_id = stored.json()["grid_id"]
    response = await client.post(f"/v1/correct?grid_id={grid_id}", content=jpeg)
    assert response.headers["unbend-model"] == "a??Set-Cookie: x=?"


async def test_a_nan_literal_is_explained(client: httpx.AsyncClient) -> None:
    """Python's json module writes NaN, which is not JSON; the answer says so."""
    response = await client.post("/v1/grids", content=with_source("NaN"))
    assert "NaN" in response.json()["allowed"]


async def test_a_large_upload_is_refused(client: httpx.AsyncClient) -> None:
    """Grids are bounded by the same setting as pictures."""
    response = await client.post("/v1/grids", content=b" " * 300_001)
    assert (response.status_code, response.json()["setting"]) == (413, "body_bytes")


async def test_export_as_json_is_the_record(client: httpx.AsyncClient) -> None:
    """json is the default format of an export."""
    stored = await client.post("/v1/grids", json={"grid": GRID.to_dict()})
    exported = await client.get(f"/v1/grids/{GRID.id}/export")
    assert exported.json() == stored.json()
    assert GRID.id in exported.headers["content-disposition"]


async def test_exported_maps_drive_opencv(client: httpx.AsyncClient) -> None:
    """cv2.remap with the exported maps draws what the service draws."""
    await client.post("/v1/grids", json={"grid": GRID.to_dict()})
    response = await client.get(f"/v1/grids/{GRID.id}/export?format=npz&width=160&height=120")
    maps: Any = np.load(io.BytesIO(response.content))
    assert maps["map_x"].shape == maps["map_y"].shape == (120, 160)
    assert maps["map_x"].dtype == np.float32
    pixels = np.asarray(chequers())
    drawn = cv2.remap(pixels, maps["map_x"], maps["map_y"], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    expected = draw_through(Frame(PixelFormat.RGB24, 160, 120, pixels.reshape(-1)), GRID, BLACK)
    inside = expected.reshape(120, 160, 3).max(-1) > 0
    assert np.abs(drawn.astype(int) - expected.reshape(120, 160, 3))[inside].max() <= 1


@pytest.mark.parametrize(
    "query",
    [
        "format=npz",
        "format=npz&width=10",
        "format=npz&width=0&height=5",
        "format=npz&width=60000&height=60000",
        "format=stmap",
    ],
)
async def test_an_export_has_a_bounded_size(client: httpx.AsyncClient, query: str) -> None:
    """Maps without a size, or of more pixels than is sensible, are refused."""
    await client.post("/v1/grids", json={"grid": GRID.to_dict()})
    response = await client.get(f"/v1/grids/{GRID.id}/export?{query}")
    assert (response.status_code, response.json()["code"]) == (422, "invalid_option")


async def test_unknown_grids_are_not_found(client: httpx.AsyncClient) -> None:
    """Every way to an unknown grid is a 404."""
    for response in (await client.get("/v1/grids/gnope"), await client.get("/v1/grids/gnope/export")):
        assert (response.status_code, response.json()["code"]) == (404, "grid_not_found")


@pytest.mark.parametrize(
    ("query", "magic"),
    [
        ("format=npz-fixed", b"PK"),
        ("format=stmap-tiff&direction=redistort", b"II*"),
        ("format=ffmpeg&fit=crop&strength=0.5", b"PK"),
        ("format=json&direction=redistort", b"{"),
    ],
)
async def test_a_grid_travels_in_every_form(client: httpx.AsyncClient, query: str, magic: bytes) -> None:
    """Each format comes as the file that it is, under a name that says what it is of."""
    await client.post("/v1/grids", json={"grid": GRID.to_dict()})
    response = await client.get(f"/v1/grids/{GRID.id}/export?{query}&width=64&height=48")
    assert response.status_code == 200
    assert response.content.startswith(magic)
    assert GRID.id in response.headers["content-disposition"]


async def test_an_exported_map_is_imported_as_the_grid_that_it_was(client: httpx.AsyncClient) -> None:
    """A redistortion written for another program and read back as one is the correction again."""
    await client.post("/v1/grids", json={"grid": GRID.to_dict()})
    query = "format=stmap-tiff&direction=redistort"
    file = await client.get(f"/v1/grids/{GRID.id}/export?{query}&width=128&height=96")
    read = await client.post(f"/v1/grids/import?{query}&points=9", content=file.content)
    assert read.status_code == 201
    again = Grid.from_dict((await client.get(read.headers["location"])).json()["grid"])
    assert np.abs(again.source - GRID.source)[1:-1, 1:-1].max() * 64 < 0.2


@pytest.mark.parametrize(
    ("query", "body", "code"),
    [
        ("format=npz", b"PK nonsense", "invalid_grid"),
        ("format=opencv", b'{"K": 1}', "invalid_grid"),
        ("format=stmap-tiff", b"", "invalid_grid"),
        ("format=dng", b"x", "invalid_option"),
        ("", b"x", "invalid_option"),
        ("format=npz&points=1", b"x", "invalid_option"),
    ],
)
async def test_a_bad_import_is_a_problem(client: httpx.AsyncClient, query: str, body: bytes, code: str) -> None:
    response = await client.post(f"/v1/grids/import?{query}", content=body)
    assert (response.status_code, response.json()["code"]) == (422, code)
