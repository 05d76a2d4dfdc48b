from __future__ import annotations

import io
from xml.etree import ElementTree

import httpx
import numpy as np
import pytest
from PIL import Image

from unbend_service.domain.grid import Grid

from .conftest import chequers, encoded


@pytest.mark.parametrize("what", ["guides", "grid", "displacement"])
@pytest.mark.parametrize("image_format", ["jpeg", "png", "webp"])
async def test_a_picture_of_the_estimate(client: httpx.AsyncClient, what: str, image_format: str) -> None:
    """The picture comes back at its size and in its format, with something drawn over it and most of it visible."""
    response = await client.post(f"/v1/overlay?what={what}", content=encoded(chequers(320, 240), image_format))
    assert response.headers["content-type"] == f"image/{image_format}"
    picture = Image.open(io.BytesIO(response.content)).convert("RGB")
    assert picture.size == (320, 240)
    changed = np.abs(np.asarray(picture).astype(int) - np.asarray(chequers(320, 240)).astype(int)).max(-1) > 60
    assert 0.005 < changed.mean() < 0.6
    assert response.headers["unbend-grid-id"]


async def test_the_subject_is_chosen_from_a_list(client: httpx.AsyncClient, jpeg: bytes) -> None:
    """Anything else is named."""
    response = await client.post("/v1/overlay?what=everything", content=jpeg)
    assert response.status_code == 422
    assert "what" in response.json()["detail"]


async def test_a_stored_grid_can_be_drawn(client: httpx.AsyncClient, jpeg: bytes) -> None:
    """A grid without guides is drawn as lattice or arrows, and says so when its guides are wanted."""
    stored = (await client.post("/v1/grids", json={"grid": Grid.identity(9, 9).to_dict()})).json()["grid_id"]
    assert (await client.post(f"/v1/overlay?what=grid&grid_id={stored}", content=jpeg)).status_code == 200
    response = await client.post(f"/v1/overlay?what=guides&grid_id={stored}", content=jpeg)
    assert (response.status_code, response.json()["code"]) == (422, "invalid_option")


@pytest.mark.parametrize("what", ["grids", "magnitude", "sheet"])
async def test_figures_show_more_than_the_picture(client: httpx.AsyncClient, what: str) -> None:
    """Panels and legends stand beside it, in the format that was asked for."""
    response = await client.post(
        f"/v1/overlay?what={what}&format=png&fit=keep", content=encoded(chequers(320, 240), "jpeg")
    )
    assert response.headers["content-type"] == "image/png"
    width, height = Image.open(io.BytesIO(response.content)).size
    assert width > 320
    assert height >= 240


@pytest.mark.parametrize("what", ["guides", "grid", "displacement", "grids", "magnitude", "sheet"])
async def test_every_figure_comes_as_svg(client: httpx.AsyncClient, jpeg: bytes, what: str) -> None:
    """One document with nothing outside of it, and nothing in it that runs."""
    response = await client.post(f"/v1/overlay?what={what}&format=svg", content=jpeg)
    assert response.headers["content-type"].startswith("image/svg+xml")
    root = ElementTree.fromstring(response.content)
    assert root.tag == "{http://www.w3.org/2000/svg}svg"
    assert b"script" not in response.content
    assert all(
        element.get("href", "data:").startswith("data:image/png") for element in root.iter() if element.get("href")
    )
