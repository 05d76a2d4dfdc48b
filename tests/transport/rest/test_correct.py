from __future__ import annotations

import io
import struct
import zlib

import httpx
import numpy as np
import pytest
from PIL import Image

from tests.fakes import draw_through
from unbend_service.domain.errors import QueueFull
from unbend_service.domain.fit import Fit, with_fit, with_strength
from unbend_service.domain.frames import BLACK, Frame, PixelFormat
from unbend_service.domain.grid import Grid
from unbend_service.domain.guides import Guides

from .conftest import Bench, chequers, encoded


def opened(response: httpx.Response) -> Image.Image:
    assert response.status_code == 200, response.text
    return Image.open(io.BytesIO(response.content))


def oversized_png(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", b"")


@pytest.mark.parametrize("image_format", ["jpeg", "png", "webp"])
async def test_the_format_stays(client: httpx.AsyncClient, image_format: str) -> None:
    """A picture comes back in the format it was sent in, at its size."""
    response = await client.post("/v1/correct", content=encoded(chequers(), image_format))
    assert response.headers["content-type"] == f"image/{image_format}"
    picture = opened(response)
    assert (picture.format or "").lower() == image_format
    assert picture.size == chequers().size


@pytest.mark.parametrize("image_format", ["tiff", "bmp"])
async def test_formats_that_are_only_read_come_back_as_png(client: httpx.AsyncClient, image_format: str) -> None:
    """tiff and bmp are answered without loss."""
    response = await client.post("/v1/correct", content=encoded(chequers(), image_format))
    assert response.headers["content-type"] == "image/png"


@pytest.mark.parametrize("image_format", ["jpeg", "png", "webp"])
async def test_another_format_may_be_asked_for(client: httpx.AsyncClient, jpeg: bytes, image_format: str) -> None:
    """The format parameter decides."""
    response = await client.post(f"/v1/correct?format={image_format}", content=jpeg)
    assert (opened(response).format or "").lower() == image_format


@pytest.mark.parametrize(
    ("query", "fit", "strength"),
    [("", "crop", 1.0), ("?fit=keep", "keep", 1.0), ("?fit=full&strength=0.5", "full", 0.5), ("?fit=0.3", "0.3", 1.0)],
)
async def test_the_picture_is_the_one_that_was_asked_for(bench: Bench, query: str, fit: str, strength: float) -> None:
    """Fit and strength are those of the query; the default is the crop without invalid pixels."""
    body = encoded(chequers(), "png")
    response = await bench.client.post("/v1/correct" + query, content=body)
    record = await bench.service.grids.get(response.headers["unbend-grid-id"])
    grid = with_fit(with_strength(record.grid, strength), Fit.parse(fit))
    pixels = np.asarray(chequers())
    frame = Frame(PixelFormat.RGB24, 160, 120, pixels.reshape(-1))
    np.testing.assert_array_equal(np.asarray(opened(response)).reshape(-1), draw_through(frame, grid, BLACK))
    assert float(response.headers["unbend-strength"]) == strength


async def test_what_was_decided_stands_in_the_headers(client: httpx.AsyncClient, jpeg: bytes) -> None:
    """Grid id, confidence and outcome come back with the picture."""
    headers = (await client.post("/v1/correct", content=jpeg)).headers
    assert headers["unbend-outcome"] == "corrected"
    assert float(headers["unbend-confidence"]) == 0.9
    assert headers["unbend-confidence-kind"] == "mirror_agreement"
    assert headers["unbend-model"] == "fake"
    assert "unbend-reason" not in headers
    assert (await client.get(f"/v1/grids/{headers['unbend-grid-id']}")).status_code == 200


async def test_a_picture_that_is_not_trusted_comes_back_as_it_was(bench: Bench, jpeg: bytes) -> None:
    """Left alone means byte for byte, with the reason."""
    response = await bench.client.post("/v1/correct?min_confidence=0.95", content=jpeg)
    assert response.content == jpeg
    assert response.headers["unbend-outcome"] == "left_alone"
    assert response.headers["unbend-reason"] == "low_confidence"
    bench.estimator.guides = Guides.straight()
    other = jpeg + b"\0"  # the same picture would not be looked at again
    response = await bench.client.post("/v1/correct", content=other)
    assert response.content == other
    assert response.headers["unbend-reason"] == "nothing_to_correct"
    assert bench.pool.rendered == 0


async def test_a_stored_grid_is_used_without_an_estimate(bench: Bench, jpeg: bytes) -> None:
    """Many pictures of one camera are corrected alike."""
    first = await bench.client.post("/v1/correct", content=jpeg)
    estimates = len(bench.estimator.seen)
    grid_id = first.headers["unbend-grid-id"]
    again = await bench.client.post(f"/v1/correct?grid_id={grid_id}", content=jpeg)
    assert again.content == first.content
    assert again.headers["unbend-grid-id"] == grid_id
    assert len(bench.estimator.seen) == estimates


async def test_every_call_gives_a_picture_the_same_grid(client: httpx.AsyncClient, jpeg: bytes) -> None:
    """Correct, estimate and overlay agree on the grid of a picture."""
    corrected = await client.post("/v1/correct", content=jpeg)
    drawn = await client.post("/v1/overlay", content=jpeg)
    estimated = await client.post("/v1/estimate", content=jpeg)
    grid_id = estimated.json()["grid_id"]
    assert corrected.headers["unbend-grid-id"] == drawn.headers["unbend-grid-id"] == grid_id


async def test_orientation_is_applied_and_metadata_kept(client: httpx.AsyncClient) -> None:
    """A picture taken with the camera turned comes back upright, with its EXIF and colour profile."""
    exif = Image.Exif()
    exif[0x0112], exif[0x010F] = 6, "A maker"
    profile = bytes(16) + b"RGB " + bytes(108)
    stored = chequers().transpose(Image.Transpose.ROTATE_90)
    body = encoded(stored, "jpeg", exif=exif.tobytes(), icc_profile=profile, quality=95, subsampling=0)
    picture = opened(await client.post("/v1/correct?strength=0", content=body))
    assert picture.size == chequers().size
    assert picture.getexif()[0x0112] == 1
    assert picture.getexif()[0x010F] == "A maker"
    assert picture.info["icc_profile"] == profile
    assert np.abs(np.asarray(picture).astype(int) - np.asarray(chequers()).astype(int)).mean() < 6


async def test_the_border_is_painted(client: httpx.AsyncClient) -> None:
    """Where the frame shows no picture, the border colour is painted; transparent where the format has alpha."""
    shrunk = Grid((1.5 * Grid.identity(9, 9).source).astype(np.float32))
    stored = await client.post("/v1/grids", json={"grid": shrunk.to_dict()})
    body = encoded(chequers(), "png")
    query = f"/v1/correct?fit=keep&grid_id={stored.json()['grid_id']}"
    assert opened(await client.post(f"{query}&border=ff8000", content=body)).getpixel((1, 1)) == (255, 128, 0)
    assert opened(await client.post(f"{query}&border=%23FF8000", content=body)).getpixel((1, 1)) == (255, 128, 0)
    assert opened(await client.post(f"{query}&border=white", content=body)).getpixel((1, 1)) == (255, 255, 255)
    clear = opened(await client.post(f"{query}&border=transparent", content=body))
    assert clear.mode == "RGBA"
    assert clear.getpixel((1, 1)) == (0, 0, 0, 0)
    assert clear.getpixel((80, 60))[3] == 255
    refused = await client.post(f"{query}&border=transparent&format=jpeg", content=body)
    assert (refused.status_code, refused.json()["code"]) == (422, "invalid_option")


async def test_quality_decides_the_size(client: httpx.AsyncClient, jpeg: bytes) -> None:
    """A lower quality gives a smaller file."""
    low = await client.post("/v1/correct?quality=20", content=jpeg)
    high = await client.post("/v1/correct?quality=95", content=jpeg)
    assert len(low.content) < len(high.content) / 2


async def test_a_form_is_accepted(client: httpx.AsyncClient, jpeg: bytes) -> None:
    """Browsers and libraries that only send forms get the same answer."""
    raw = await client.post("/v1/correct", content=jpeg)
    for name in ("image", "file"):
        form = await client.post("/v1/correct", files={name: ("photo.jpg", jpeg, "image/jpeg")})
        assert form.content == raw.content
        assert form.headers["unbend-grid-id"] == raw.headers["unbend-grid-id"]


BAD_BODIES = {
    "empty": (b"", 422, "empty_body"),
    "text": (b"this is no image", 415, "unsupported_media_type"),
    "truncated": (encoded(chequers(), "jpeg", quality=90)[:-900], 422, "invalid_image"),
    "bomb": (oversized_png(30_000, 30_000), 422, "too_many_pixels"),
    "long": (bytes(300_001), 413, "body_too_large"),
}


@pytest.mark.parametrize("name", BAD_BODIES)
@pytest.mark.parametrize("path", ["/v1/correct", "/v1/estimate", "/v1/overlay"])
async def test_a_bad_body_is_named_and_the_service_still_serves(
    client: httpx.AsyncClient, jpeg: bytes, path: str, name: str
) -> None:
    """Every kind of bad picture has its own status and code, and the next good one is answered."""
    body, status, code = BAD_BODIES[name]
    for content in ({"content": body}, {"files": {"image": ("x", body, "image/jpeg")}}):
        response = await client.post(path, **content)
        assert (response.status_code, response.json()["code"]) == (status, code)
    assert (await client.post(path, content=jpeg)).status_code == 200


async def test_content_type_is_not_believed(client: httpx.AsyncClient, jpeg: bytes) -> None:
    """The bytes decide, not what the sender calls them."""
    for content_type in ("image/png", "text/plain", "application/x-www-form-urlencoded"):
        response = await client.post("/v1/correct", content=jpeg, headers={"content-type": content_type})
        assert response.headers["content-type"] == "image/jpeg"


async def test_an_unknown_grid_is_not_found(client: httpx.AsyncClient, jpeg: bytes) -> None:
    """A grid id that nobody stored is a 404 that names it."""
    response = await client.post("/v1/correct?grid_id=gnope", content=jpeg)
    assert (response.status_code, response.json()["code"]) == (404, "grid_not_found")
    assert "gnope" in response.json()["detail"]


async def test_a_full_queue_says_when_to_come_back(bench: Bench, jpeg: bytes) -> None:
    """Overload is answered at once, with Retry-After, and passes."""
    bench.pool.failure = QueueFull("Too many frames wait.", setting="queue_frames", retry_after_s=1.0)
    response = await bench.client.post("/v1/correct", content=jpeg)
    assert (response.status_code, response.headers["retry-after"]) == (429, "1")
    bench.pool.failure = None
    assert (await bench.client.post("/v1/correct", content=jpeg)).status_code == 200
