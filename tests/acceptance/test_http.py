from __future__ import annotations

import json
import urllib.error
import urllib.request
import zlib
from email.message import Message

import cv2
import numpy as np
import pytest

from tests.acceptance.conftest import Server


def post(server: Server, path: str, body: bytes, method: str = "POST") -> tuple[int, dict[str, str], bytes]:
    request = urllib.request.Request(f"http://{server.http}{path}", data=body, method=method)
    request.add_header("Content-Type", "application/octet-stream")
    try:
        with urllib.request.urlopen(request, timeout=60) as answer:
            return answer.status, titled(answer.headers), answer.read()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, titled(error.headers), error.read()


def titled(headers: Message) -> dict[str, str]:
    return {name.title(): value for name, value in headers.items()}


def facade(width: int = 640, height: int = 480, bend: float = 0.25) -> np.ndarray:
    """(height, width, 3) uint8: rows of windows through a barrel lens (division model, frame of the half diagonal)."""
    drawn = np.full((round(1280 * height / width), 1280, 3), 190, np.uint8)
    for x in range(60, drawn.shape[1] - 80, 120):
        for y in range(60, drawn.shape[0] - 120, 160):
            cv2.rectangle(drawn, (x, y), (x + 70, y + 110), (60, 50, 40), -1)
            cv2.rectangle(drawn, (x + 6, y + 6), (x + 64, y + 104), (150, 130, 110), 3)
    straight = cv2.resize(drawn, (2 * width, 2 * height))
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    dx, dy = (x - width / 2 + 0.5) / (width / 2), (y - height / 2 + 0.5) / (width / 2)
    scale = 1 / (1 - bend * (dx**2 + dy**2) / (1 + (height / width) ** 2))
    zoom = width * (1 - bend)
    map_x, map_y = (width + dx * scale * zoom).astype(np.float32), (height + dy * scale * zoom).astype(np.float32)
    return cv2.remap(straight, map_x, map_y, cv2.INTER_AREA)


@pytest.fixture(scope="module")
def photo() -> bytes:
    return cv2.imencode(".jpg", facade(), [cv2.IMWRITE_JPEG_QUALITY, 92])[1].tobytes()


def test_a_photograph_comes_back_corrected_in_the_same_format_and_both_calls_are_counted(
    server: Server, photo: bytes
) -> None:
    before = server.metric("unbend_requests_total", transport="http", code="200")
    status, headers, body = post(server, "/v1/correct", photo)
    assert status == 200
    assert headers["Content-Type"] == "image/jpeg"
    corrected = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR)
    assert corrected.shape == (480, 640, 3)
    assert not np.array_equal(corrected, cv2.imdecode(np.frombuffer(photo, np.uint8), cv2.IMREAD_COLOR))

    status, _, body = post(server, "/v1/estimate", photo)
    estimate = json.loads(body)
    assert status == 200
    assert {"grid_id", "confidence", "outcome", "guides", "grid", "model"} <= estimate.keys()
    grid = estimate["grid"]
    assert len(grid["source"]) == grid["rows"] * grid["columns"]
    assert {"anchor", "coefficients"} == estimate["guides"]["rows"][0].keys()
    assert server.metric("unbend_requests_total", transport="http", code="200") >= before + 2


def test_a_grid_travels_out_and_in_again_and_gives_the_same_picture(server: Server, photo: bytes) -> None:
    _, headers, body = post(server, "/v1/correct?format=png", photo)
    grid_id = headers["Unbend-Grid-Id"]
    stored = server.get(f"/v1/grids/{grid_id}")
    assert post(server, f"/v1/grids/{grid_id}", b"", "DELETE")[0] in (200, 204)
    assert post(server, f"/v1/correct?grid_id={grid_id}", photo)[0] == 404
    assert post(server, f"/v1/grids/{grid_id}", stored, "PUT")[0] in (200, 201)
    assert post(server, f"/v1/correct?format=png&grid_id={grid_id}", photo)[2] == body


def png_header(width: int, height: int) -> bytes:
    chunk = b"IHDR" + width.to_bytes(4, "big") + height.to_bytes(4, "big") + b"\x08\x02\x00\x00\x00"
    return b"\x89PNG\r\n\x1a\n" + b"\x00\x00\x00\x0d" + chunk + zlib.crc32(chunk).to_bytes(4, "big")


def grid_json(points: list[object], rows: int = 2, columns: int = 2) -> bytes:
    return json.dumps({"grid": {"rows": rows, "columns": columns, "source": points}}).encode()


@pytest.mark.parametrize(
    ("path", "body", "status", "code"),
    [
        ("/v1/correct", b"", 422, "empty_body"),
        ("/v1/correct", b"this is not a picture, it is a sentence", 415, "unsupported_media_type"),
        ("/v1/correct", "truncated", 422, "invalid_image"),
        ("/v1/correct", png_header(30_000, 30_000), 422, "too_many_pixels"),
        ("/v1/correct?grid_id=g" + "0" * 32, "photo", 404, "grid_not_found"),
        ("/v1/correct?fit=banana", "photo", 422, "invalid_option"),
        ("/v1/correct?strength=2", "photo", 422, "invalid_option"),
        ("/v1/grids", grid_json([[float("nan"), 0], [1, -1], [-1, 1], [1, 1]]), 422, "invalid_grid"),
        ("/v1/grids", grid_json([[-1, -1], [1, -1], [1, 1], [-1, 1]]), 422, "folded_grid"),
        ("/v1/grids", b"{", 422, None),
    ],
)
def test_bad_input_gets_a_typed_problem_and_the_service_still_serves(
    server: Server, photo: bytes, path: str, body: bytes | str, status: int, code: str | None
) -> None:
    sent = {"truncated": photo[: len(photo) // 2], "photo": photo}.get(body, body) if isinstance(body, str) else body
    assert isinstance(sent, bytes)
    answered, headers, problem = post(server, path, sent)
    assert answered == status, problem
    assert headers["Content-Type"].startswith("application/problem+json")
    assert b"Traceback" not in problem
    if code is not None:
        assert json.loads(problem)["code"] == code
    assert post(server, "/v1/estimate", photo)[0] == 200


def test_the_renderer_and_its_device_are_in_the_log_in_readyz_and_in_the_metrics(server: Server) -> None:
    ready = json.loads(server.get("/readyz"))
    line = next(entry for entry in server.lines if entry["event"] == "ready")
    assert ready["ready"]
    assert ready["renderer"]["name"] == line["renderer"]
    assert ready["renderer"]["device"] == line["device"]
    assert f'name="{line["renderer"]}"' in server.get("/metrics").decode()
