"""Grids kept in Redis: replicas on many machines share them."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any, cast

import structlog

from unbend_service.adapters.grid_stores import redis_scripts as scripts
from unbend_service.adapters.grid_stores.values import Unreadable, pack, unpack
from unbend_service.application.ports import Meter
from unbend_service.domain.errors import GridNotFound, GridStoreUnavailable, InvalidOption
from unbend_service.domain.records import GridRecord
from unbend_service.settings import Settings

try:
    import redis.asyncio as redis
    from redis.asyncio.retry import Retry
    from redis.backoff import NoBackoff
    from redis.exceptions import ConnectionError as ConnectionLost
    from redis.exceptions import RedisError
except ImportError:  # pragma: no cover - the extra [redis]; said in words when the store is asked for
    redis = None  # type: ignore[assignment]

log = structlog.get_logger(__name__)

BINDING_VERSION = b"1"
_CONNECTIONS = 32


class RedisGridStore:
    """Port GridStore over one Redis server, or a fail-over address of several.

    Every operation is one script, so replicas never see half of it. What comes back is checked against what was asked:
    a lattice against its id, a binding against its stream. A value of another version, or a damaged one, is as good as
    absent.

    Args:
        settings: ``redis_*``; ``grid_store_entries`` bounds grids and stream bindings each, ``grid_store_ttl_s`` counts
            from the last use.
        clock: seconds since the epoch; None takes the clock of the server, so that those of the replicas do not matter.

    Raises:
        InvalidOption: the URL is none, or the package redis is not installed. Every call raises GridStoreUnavailable
            when the server fails or does not answer within ``redis_timeout_s``.
    """

    def __init__(self, settings: Settings, meter: Meter, clock: Callable[[], float] | None = None) -> None:
        if redis is None:
            raise InvalidOption("The redis grid store needs the extra [redis].", setting="grid_store")
        self._meter = meter
        self._clock = clock
        self._timeout_s = settings.redis_timeout_s
        self._prefix = f"{{{settings.redis_prefix}}}"  # in braces: one hash slot
        self._ttl_us = round(settings.grid_store_ttl_s * 1e6)
        self._entries = settings.grid_store_entries
        self._server = _connect(settings)
        self._scripts = {source: self._server.register_script(source) for source in _SOURCES}

    async def ping(self) -> None:
        """Raises GridStoreUnavailable unless the server answers."""
        await self._ask(lambda: cast(Awaitable[Any], self._server.ping()))

    async def put(self, record: GridRecord) -> None:
        await self._run(scripts.PUT, record.id, pack(record))

    async def get(self, grid_id: str) -> GridRecord:
        """Raises GridNotFound."""
        value = await self._run(scripts.GET, grid_id)
        if value is None:
            raise GridNotFound(f"No grid is stored as {grid_id!r}.")
        try:
            return unpack(grid_id, value)
        except Unreadable as error:
            self._meter.grid_store("get", "unreadable")
            log.warning("stored grid is unreadable", grid_id=grid_id, found=str(error))
            raise GridNotFound(f"What is stored as {grid_id!r} cannot be read.") from error

    async def delete(self, grid_id: str) -> None:
        """Raises GridNotFound."""
        if not await self._run(scripts.DELETE, grid_id):
            raise GridNotFound(f"No grid is stored as {grid_id!r}.")

    async def bind_stream(self, stream_id: str, grid_id: str, *, replace: bool = True) -> str:
        """The grid id that is bound now; without ``replace`` the one that was, while its grid is kept."""
        found = await self._run(scripts.BIND, stream_id, BINDING_VERSION, grid_id, int(replace))
        return self._bound_grid(stream_id, found)

    async def stream_grid(self, stream_id: str) -> str | None:
        """The grid id that was bound; None if there is none, or its grid is gone."""
        found = await self._run(scripts.STREAM, stream_id, BINDING_VERSION)
        return None if found is None else self._bound_grid(stream_id, found)

    async def claim_stream(self, stream_id: str, token: str, lease_s: float) -> bool:
        """Whether ``token`` holds the claim, for ``lease_s`` seconds from now."""
        return bool(await self._run(scripts.CLAIM, stream_id, token, max(1, round(lease_s * 1000))))

    async def release_stream(self, stream_id: str, token: str) -> None:
        await self._run(scripts.RELEASE, stream_id, token)

    async def camera(self, name: str) -> bytes | None:
        found = await self._run(scripts.CAMERA, name)
        return None if found is None else bytes(found)

    async def swap_camera(self, name: str, known: bytes | None, value: bytes | None) -> bool:
        arguments = [part for one in (known, value) for part in ((0, b"") if one is None else (1, one))]
        return bool(await self._run(scripts.SWAP_CAMERA, name, *arguments))

    async def close(self) -> None:
        await self._server.aclose()

    def _bound_grid(self, stream_id: str, found: list[bytes]) -> str:
        if found[0].decode() != stream_id:
            raise GridStoreUnavailable("The grid store answered for another stream.", setting="redis_url")
        return found[1].decode()

    async def _run(self, source: str, *arguments: str | bytes | int) -> Any:
        now_us = -1 if self._clock is None else round(self._clock() * 1e6)
        values = [self._prefix, now_us, self._ttl_us, self._entries, *arguments]
        return await self._ask(lambda: self._scripts[source](args=values))

    async def _ask(self, work: Callable[[], Awaitable[Any]]) -> Any:
        try:
            async with asyncio.timeout(self._timeout_s):
                return await work()
        except TimeoutError as error:  # ours; that of redis-py is a RedisError
            reason = f"no answer within {self._timeout_s:g} s"
            raise GridStoreUnavailable(f"The grid store failed: {reason}.", setting="redis_url") from error
        except (RedisError, OSError) as error:
            raise GridStoreUnavailable(f"The grid store failed: {error}.", setting="redis_url") from error


_SOURCES = (
    scripts.PUT,
    scripts.GET,
    scripts.DELETE,
    scripts.BIND,
    scripts.STREAM,
    scripts.CLAIM,
    scripts.RELEASE,
    scripts.CAMERA,
    scripts.SWAP_CAMERA,
)


def _connect(settings: Settings) -> redis.Redis:
    """A client that connects when it is asked first. What the settings say goes before what the URL says."""
    password = settings.redis_password
    chosen: dict[str, Any] = {
        "username": settings.redis_username,
        "password": password.get_secret_value() if password is not None else None,
    }
    if settings.redis_url.startswith("rediss:"):
        chosen |= {
            "ssl_ca_certs": _text(settings.redis_ca_file),
            "ssl_certfile": _text(settings.redis_cert_file),
            "ssl_keyfile": _text(settings.redis_key_file),
        }
    try:
        pool = redis.BlockingConnectionPool.from_url(
            settings.redis_url,
            max_connections=_CONNECTIONS,
            timeout=settings.redis_timeout_s,
            socket_connect_timeout=settings.redis_timeout_s,
            socket_timeout=settings.redis_timeout_s,
            health_check_interval=30,
            # a connection that the server closed while it was idle is no outage: once more, over a new one
            retry=Retry(NoBackoff(), 1, supported_errors=(ConnectionLost,)),
            **{name: value for name, value in chosen.items() if value is not None},
        )
    except ValueError as error:
        raise InvalidOption(
            "The address of redis is none.", allowed="redis://, rediss:// or unix://", setting="redis_url"
        ) from error
    return redis.Redis.from_pool(pool)


def _text(path: object) -> str | None:
    return None if path is None else str(path)
