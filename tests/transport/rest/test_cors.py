from __future__ import annotations

from collections.abc import AsyncIterator

import pytest

from unbend_service.domain.errors import InvalidOption
from unbend_service.settings import Settings
from unbend_service.transport.rest.app import allowed_origins

from .conftest import Bench

FRIEND, STRANGER = "https://gallery.example", "https://stranger.example"
PREFLIGHT = {"Access-Control-Request-Method": "POST", "Access-Control-Request-Headers": "authorization"}


@pytest.fixture
async def open_bench() -> AsyncIterator[Bench]:
    built = Bench(Settings(cors_origins=f"{FRIEND}, http://localhost:3000"))
    await built.service.start()
    yield built
    await built.close()


async def test_no_other_page_may_call_unless_it_is_named(bench: Bench, jpeg: bytes) -> None:
    asked = await bench.client.options("/v1/correct", headers={"Origin": FRIEND, **PREFLIGHT})
    assert asked.status_code == 405
    answered = await bench.client.post("/v1/estimate", content=jpeg, headers={"Origin": FRIEND})
    for answer in (asked, answered):
        assert not [name for name in answer.headers if name.startswith("access-control-")]
    assert answered.headers["cross-origin-resource-policy"] == "same-origin"


async def test_a_page_that_is_named_may_call_and_others_may_not(open_bench: Bench, jpeg: bytes) -> None:
    client = open_bench.client
    asked = await client.options("/v1/correct", headers={"Origin": FRIEND, **PREFLIGHT})
    assert asked.status_code == 200
    assert asked.headers["access-control-allow-origin"] == FRIEND
    answered = await client.post("/v1/estimate", content=jpeg, headers={"Origin": FRIEND})
    assert answered.headers["access-control-allow-origin"] == FRIEND
    assert "Unbend-Grid-Id" in answered.headers["access-control-expose-headers"]
    assert "access-control-allow-credentials" not in answered.headers
    refused = await client.options("/v1/correct", headers={"Origin": STRANGER, **PREFLIGHT})
    assert refused.status_code == 400
    assert "access-control-allow-origin" not in refused.headers


@pytest.mark.parametrize("origins", ["*", "null", "gallery.example", "https://a.example/path", "https://*.example"])
def test_what_is_no_origin_is_refused(origins: str) -> None:
    with pytest.raises(InvalidOption, match="no origin") as failure:
        allowed_origins(Settings(cors_origins=origins))
    assert failure.value.setting == "cors_origins"


async def test_pages_may_not_be_framed_and_may_load_from_here_only(bench: Bench) -> None:
    headers = (await bench.client.get("/")).headers
    assert headers["x-frame-options"] == "DENY"
    assert "frame-ancestors 'none'" in headers["content-security-policy"]
    assert "'unsafe" not in headers["content-security-policy"]
    assert headers["cross-origin-opener-policy"] == "same-origin"
    assert headers["referrer-policy"] == "no-referrer"
    assert "camera=()" in headers["permissions-policy"]
