from __future__ import annotations

import io

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


async def test_the_subject_is_chosen_from_three(client: httpx.AsyncClient, jpeg: bytes) -> None:
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
