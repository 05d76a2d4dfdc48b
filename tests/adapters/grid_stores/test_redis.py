from __future__ import annotations

import asyncio
import secrets
import subprocess
import time
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
import redis.asyncio

from benchmarks.companions import Companion, free_port, redis_server
from tests.companions import started
from tests.fakes import RecordingMeter, barrel_guides
from unbend_service.adapters.grid_stores.redis import RedisGridStore
from unbend_service.adapters.grid_stores.values import pack
from unbend_service.domain.errors import GridNotFound, GridStoreUnavailable, InvalidOption
from unbend_service.domain.grid import Grid
from unbend_service.domain.records import GridRecord
from unbend_service.settings import Settings

RECORD = GridRecord(Grid.from_map(barrel_guides(), 9, 9))
OTHER = GridRecord(Grid.from_map(barrel_guides(0.02), 9, 9))


@pytest.fixture
def settings(redis: Companion) -> Settings:
    url = f"redis://127.0.0.1:{redis.port}/0"
    return Settings(redis_url=url, redis_prefix=f"t{secrets.token_hex(6)}", redis_timeout_s=10.0)


@pytest.fixture
async def raw(settings: Settings) -> AsyncIterator[redis.asyncio.Redis]:
    """The server as another program sees it."""
    client = redis.asyncio.Redis.from_url(settings.redis_url)
    yield client
    await client.aclose()


@pytest.fixture
async def store(settings: Settings) -> AsyncIterator[RedisGridStore]:
    built = RedisGridStore(settings, RecordingMeter())
    yield built
    await built.close()


def key(settings: Settings, name: str) -> str:
    return f"{{{settings.redis_prefix}}}:{name}"


async def test_replicas_share_grids_streams_and_claims(store: RedisGridStore, settings: Settings) -> None:
    """What one replica stores, another finds, and only one of them estimates a stream."""
    other = RedisGridStore(settings, RecordingMeter())
    await store.put(RECORD)
    await store.bind_stream("camera-7", RECORD.id)
    assert (await other.get(RECORD.id)).to_dict() == RECORD.to_dict()
    assert await other.stream_grid("camera-7") == RECORD.id
    assert await store.claim_stream("camera-8", "one", 5.0)
    assert not await other.claim_stream("camera-8", "other", 5.0)
    await other.close()


async def test_a_damaged_or_exchanged_value_is_no_grid(
    store: RedisGridStore, settings: Settings, raw: redis.asyncio.Redis
) -> None:
    """Bytes that are not the grid of that id are never handed out: it is as if there were none."""
    await store.put(RECORD)
    good = await raw.get(key(settings, f"grid:{RECORD.id}"))
    for bad in (pack(OTHER), good[:-4], good.replace(b'"version":1', b'"version":2'), b"", b"{}\n", b"\xff\n\xff"):
        await raw.set(key(settings, f"grid:{RECORD.id}"), bad)
        with pytest.raises(GridNotFound):
            await store.get(RECORD.id)
    await raw.set(key(settings, f"grid:{RECORD.id}"), good)
    assert (await store.get(RECORD.id)).id == RECORD.id


async def test_a_binding_of_another_version_is_none(
    store: RedisGridStore, settings: Settings, raw: redis.asyncio.Redis
) -> None:
    """Replicas of two versions may share a server: neither misreads what the other wrote."""
    await store.put(RECORD)
    await store.bind_stream("camera-7", RECORD.id)
    await raw.hset(key(settings, "stream:camera-7"), "version", "2")
    assert await store.stream_grid("camera-7") is None
    await raw.hset(key(settings, "stream:camera-7"), mapping={"version": "1", "stream": "camera-8"})
    assert await store.stream_grid("camera-7") is None


async def test_nothing_is_left_behind(settings: Settings, raw: redis.asyncio.Redis) -> None:
    """Every key expires by itself, even if no replica ever asks again."""
    store = RedisGridStore(settings.model_copy(update={"grid_store_ttl_s": 1.0}), RecordingMeter())
    await store.put(RECORD)
    await store.bind_stream("camera-7", RECORD.id)
    await store.claim_stream("camera-7", "token", 1.0)
    mine = key(settings, "*").replace("{", "\\{")
    assert len(await raw.keys(mine)) >= 4
    await asyncio.sleep(1.5)
    assert await raw.keys(mine) == []
    with pytest.raises(GridNotFound):
        await store.get(RECORD.id)
    await store.close()


async def test_a_cancelled_call_spoils_no_other(store: RedisGridStore) -> None:
    """Callers that go away in the middle of an answer leave nobody else with the answer that was theirs."""
    records = [GridRecord(Grid.from_map(barrel_guides(0.001 * i), 65, 65)) for i in range(1, 9)]
    for each in records:
        await store.put(each)
        await store.bind_stream(each.id, each.id)
    for turn in range(30):
        tasks = [asyncio.create_task(store.get(each.id)) for each in records]
        await asyncio.sleep(0.0005 * (turn % 7))
        for task in tasks[turn % 2 :: 2]:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        bound = await asyncio.gather(*(store.stream_grid(each.id) for each in records))
        assert bound == [each.id for each in records]


async def test_a_server_that_hangs_costs_the_time_out_and_no_more(tmp_path: Path) -> None:
    """A call ends with a typed error in the time that is set, and the first call after the hang is answered."""
    server = started(lambda: redis_server(tmp_path))
    url = f"redis://127.0.0.1:{server.port}/0"
    store = RedisGridStore(Settings(redis_url=url, redis_timeout_s=1.0), RecordingMeter())
    try:
        await store.put(RECORD)
        server.pause()
        start = time.monotonic()
        with pytest.raises(GridStoreUnavailable, match="redis_url"):
            await store.get(RECORD.id)
        assert time.monotonic() - start < 4.0
        server.resume()
        assert (await store.get(RECORD.id)).id == RECORD.id
        server.stop()
        with pytest.raises(GridStoreUnavailable):
            await store.get(RECORD.id)
        server.start()
        await store.ping()  # over a new connection
        with pytest.raises(GridNotFound):
            await store.get(RECORD.id)
    finally:
        await store.close()
        server.stop()


async def test_a_password_is_asked_for_and_never_told(tmp_path: Path) -> None:
    """The password comes from a setting or the URL; a wrong one is a typed error without the password in it."""
    server = started(lambda: redis_server(tmp_path, "--requirepass", "open-sesame"))
    url = f"redis://127.0.0.1:{server.port}/0"
    try:
        for chosen in ({"redis_password": "open-sesame"}, {"redis_url": url.replace("//", "//:open-sesame@")}):
            store = RedisGridStore(Settings(**{"redis_url": url, "redis_timeout_s": 10.0} | chosen), RecordingMeter())
            await store.put(RECORD)
            await store.close()
        for settings in (Settings(redis_url=url), Settings(redis_url=url, redis_password="guess-guess")):
            store = RedisGridStore(settings, RecordingMeter())
            with pytest.raises(GridStoreUnavailable) as caught:
                await store.put(RECORD)
            assert "guess-guess" not in str(caught.value) + repr(settings)
            await store.close()
    finally:
        server.stop()


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a certificate authority and a certificate for 127.0.0.1 that it signed."""
    folder = tmp_path_factory.mktemp("authority")

    def openssl(*arguments: str) -> None:
        subprocess.run(["openssl", *arguments], cwd=folder, check=True, capture_output=True)

    new = ("req", "-newkey", "rsa:2048", "-nodes", "-subj")
    openssl(*new, "/CN=test authority", "-x509", "-days", "2", "-keyout", "ca.key", "-out", "ca.pem")
    openssl(*new, "/CN=127.0.0.1", "-keyout", "server.key", "-out", "server.csr")
    (folder / "names").write_text("subjectAltName=IP:127.0.0.1\n")
    signing = ("-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial", "-days", "2", "-extfile", "names")
    openssl("x509", "-req", "-in", "server.csr", *signing, "-out", "server.pem")
    return folder


async def test_tls_is_spoken_to_a_server_whose_authority_is_known(tmp_path: Path, authority: Path) -> None:
    """rediss:// verifies the server; one that nobody vouches for is not talked to; mutual TLS shows a certificate."""
    files = {name: str(authority / f"{name}.pem") for name in ("server", "ca")}
    options = ["--tls-cert-file", files["server"], "--tls-key-file", str(authority / "server.key")]
    port = free_port()
    listening = ["--tls-port", str(port), "--port", "0", "--tls-ca-cert-file", files["ca"], *options]
    server = started(lambda: redis_server(tmp_path, *listening, port=port))
    try:
        common = {"redis_url": f"rediss://127.0.0.1:{server.port}/0", "redis_timeout_s": 10.0}
        known = common | {"redis_ca_file": files["ca"]}
        shown = known | {"redis_cert_file": files["server"], "redis_key_file": str(authority / "server.key")}
        store = RedisGridStore(Settings(**shown), RecordingMeter())
        await store.put(RECORD)
        assert (await store.get(RECORD.id)).id == RECORD.id
        await store.close()
        for refused in (common, known):
            store = RedisGridStore(Settings(**refused), RecordingMeter())
            with pytest.raises(GridStoreUnavailable):
                await store.put(RECORD)
            await store.close()
    finally:
        server.stop()


def test_an_address_that_is_none_is_named() -> None:
    """A wrong URL is said at the start, with the name of the setting."""
    with pytest.raises(InvalidOption, match="redis_url"):
        RedisGridStore(Settings(redis_url="http://127.0.0.1"), RecordingMeter())
