from __future__ import annotations

import re
from urllib.parse import urljoin

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families

from unbend_service.transport.rest.health import ReadinessBody

from .conftest import Bench


async def scraped(client: httpx.AsyncClient) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    response = await client.get("/metrics")
    assert response.headers["content-type"].startswith("text/plain")
    families = text_string_to_metric_families(response.text)
    return {(s.name, tuple(sorted(s.labels.items()))): s.value for family in families for s in family.samples}


async def test_liveness_needs_nothing(bench: Bench) -> None:
    """A process that answers is alive, ready or not."""
    bench.pool.ready = False
    response = await bench.client.get("/livez")
    assert (response.status_code, response.json()) == (200, {"live": True})


async def test_readiness_names_renderer_and_model(bench: Bench) -> None:
    """Whoever runs the service sees which renderer on which device, which model, and why it is not ready."""
    ready = await bench.client.get("/readyz")
    assert ready.status_code == 200
    body = ReadinessBody.model_validate(ready.json())
    assert body.ready
    assert body.renderer is not None
    assert (body.renderer.name, body.renderer.device, body.model.name) == ("cpu", "fake", "fake")
    bench.pool.ready = False
    waiting = await bench.client.get("/readyz")
    assert waiting.status_code == 503
    assert waiting.json()["reasons"] == ["No worker is ready yet."]


async def test_a_scrape_sees_requests_and_stages(client: httpx.AsyncClient, jpeg: bytes) -> None:
    """After one correction and one estimate, both are counted, each stage was timed, and so was a refusal."""
    await client.post("/v1/correct", content=jpeg)
    await client.post("/v1/estimate", content=jpeg)
    await client.post("/v1/estimate", content=b"text")
    await client.get("/v1/grids/gnope")
    await client.get("/made/up/by/a/scanner")
    found = await scraped(client)

    def requests(method: str, code: str) -> float | None:
        return found.get(("unbend_requests_total", (("code", code), ("method", method), ("transport", "http"))))

    assert requests("POST /v1/correct", "200") == 1
    assert requests("POST /v1/estimate", "200") == 1
    assert requests("POST /v1/estimate", "415") == 1
    assert requests("GET /v1/grids/{grid_id}", "404") == 1
    assert requests("GET other", "404") == 1
    for stage in ("decode", "estimate", "grid", "encode"):
        assert found["unbend_stage_duration_seconds_count", (("stage", stage),)] >= 1
        assert found["unbend_stage_duration_seconds_sum", (("stage", stage),)] > 0
    assert found["unbend_frames_total", (("result", "corrected"),)] == 1
    assert found["unbend_estimates_total", (("outcome", "corrected"),)] == 2
    assert found["unbend_grid_cache_requests_total", (("result", "miss"),)] == 1
    assert found["unbend_workers", (("state", "ready"),)] == 1
    device = (("device", "fake"), ("hardware", "false"), ("name", "cpu"))
    assert found["unbend_renderer_info", device] == 1
    assert any(name == "unbend_model_info" for name, _ in found)


@pytest.mark.parametrize("path", ["/", "/docs"])
async def test_pages_need_no_other_host(client: httpx.AsyncClient, path: str) -> None:
    """The pages work without the internet: whatever they load is served here."""
    page = await client.get(path)
    assert page.headers["content-type"] == "text/html; charset=utf-8"
    waiting = re.findall(r'(?:src|href)="(?!#)([^"]+)"', page.text)
    loaded: set[str] = set()
    assert waiting
    while waiting:
        address = waiting.pop()
        assert address.startswith("/"), address
        answer = await client.get(address)
        assert answer.status_code == 200, address
        loaded.add(address)
        if address.endswith(".js"):
            imported = re.findall(r'^import .* from "(.+)";$', answer.text, re.MULTILINE)
            waiting += {urljoin(address, name) for name in imported} - loaded
    assert "default-src 'none'" in page.headers["content-security-policy"]


async def test_the_landing_page_says_how(client: httpx.AsyncClient) -> None:
    """Somebody who opens the address finds the one command that straightens a picture."""
    text = (await client.get("/")).text
    assert "curl" in text
    assert "/v1/correct" in text
