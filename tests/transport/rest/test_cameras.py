"""Pictures that name their camera, over HTTP."""

from __future__ import annotations

import io

import httpx
import numpy as np
import pytest
from PIL import Image

from tests.fakes import barrel_guides

from .conftest import Bench


def picture(seed: int, size: tuple[int, int] = (96, 64), exif: Image.Exif | None = None) -> bytes:
    noise = np.random.default_rng(seed).integers(0, 255, (size[1], size[0], 3), np.uint8)
    body = io.BytesIO()
    Image.fromarray(noise).save(body, "jpeg", **({} if exif is None else {"exif": exif}))
    return body.getvalue()


def exif_of(make: str = "Acme", focal_mm: float = 4.2) -> Image.Exif:
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = make, "Wide 3"
    exif.get_ifd(0x8769)[0x920A] = focal_mm
    return exif


async def test_pictures_of_a_camera_add_up_to_one_grid(bench: Bench, client: httpx.AsyncClient) -> None:
    for number, bend in enumerate((0.05, 0.07, 0.06)):
        bench.estimator.guides = barrel_guides(bend)
        answer = await client.post("/v1/estimate", params={"camera": "door"}, content=picture(number))
        assert answer.status_code == 200

    known = (await client.get("/v1/cameras/door")).json()

    assert (known["camera"], known["pictures"], known["version"], known["locked"]) == ("door", 3, 3, False)
    alone = (await client.post("/v1/estimate", content=picture(2))).json()
    assert answer.json()["grid_id"] != alone["grid_id"]


async def test_a_locked_camera_needs_no_further_estimate(bench: Bench, client: httpx.AsyncClient) -> None:
    for number in range(17):
        await client.post("/v1/estimate", params={"camera": "door"}, content=picture(number, (32, 24)))
    assert (await client.get("/v1/cameras/door")).json()["locked"]
    looked = len(bench.estimator.seen)

    answer = await client.post("/v1/correct", params={"camera": "door"}, content=picture(99, (32, 24)))

    assert answer.status_code == 200
    assert len(bench.estimator.seen) == looked


async def test_a_camera_can_be_forgotten(client: httpx.AsyncClient) -> None:
    await client.post("/v1/estimate", params={"camera": "door"}, content=picture(1))

    assert (await client.delete("/v1/cameras/door")).status_code == 204
    assert (await client.get("/v1/cameras/door")).status_code == 404


async def test_the_file_may_name_its_camera(client: httpx.AsyncClient) -> None:
    """Make, model and focal length name it; another focal length is another camera."""
    for seed, focal_mm in ((1, 4.2), (2, 4.2), (3, 8.0)):
        body = picture(seed, exif=exif_of(focal_mm=focal_mm))
        await client.post("/v1/estimate", params={"camera": "exif"}, content=body)

    known = (await client.get("/v1/cameras/exif:Acme:Wide-3::4.2mm:1x:1.500")).json()

    assert known["pictures"] == 2


async def test_a_file_that_names_no_camera_stands_alone(client: httpx.AsyncClient) -> None:
    answer = await client.post("/v1/estimate", params={"camera": "exif"}, content=picture(1))

    assert answer.status_code == 200


@pytest.mark.parametrize(("camera", "size"), [("a b", (96, 64)), ("door", (64, 96))])
async def test_what_cannot_be_is_refused(client: httpx.AsyncClient, camera: str, size: tuple[int, int]) -> None:
    """A name with a blank; a picture that stands upright where the others lie."""
    await client.post("/v1/estimate", params={"camera": "door"}, content=picture(1))

    answer = await client.post("/v1/estimate", params={"camera": camera}, content=picture(2, size))

    assert answer.status_code == 422
    assert "allowed" in answer.json()
