"""The life of the service process: start, serve both transports, drain, stop."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import grpc
import structlog
import uvicorn

from unbend_service.application.service import Service
from unbend_service.settings import Settings
from unbend_service.transport.local.listener import MemoryListener
from unbend_service.transport.rest.app import create_app
from unbend_service.transport.rest.connections import guarded_protocol
from unbend_service.transport.rpc.server import start_server
from unbend_service.wiring import build_service

log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Addresses:
    """Where the service listens: host:port of each transport, with the ports that were really taken."""

    http: str
    grpc: str


class _HttpServer(uvicorn.Server):
    """Uvicorn without its own signal handling: the process drains both transports together."""

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


async def serve(settings: Settings, on_ready: Callable[[Addresses], None] | None = None) -> None:
    """Serves until SIGTERM or SIGINT, then drains; a second signal ends the process at once.

    Raises:
        UnbendError: the service cannot start with these settings.
        OSError: an address is taken.
    """
    stop = asyncio.Event()
    _handle_signals(stop)
    http_socket = _bound_socket(settings.http_host, settings.http_port)
    service = build_service(settings)
    listener: MemoryListener | None = None
    try:
        await service.start()
        rpc_server, rpc_port = await start_server(service, settings)
        if settings.local_socket is not None:
            listener = MemoryListener(settings.local_socket, service.regions, settings.streams)
            listener.start()
        http_server = _HttpServer(
            uvicorn.Config(
                create_app(service, settings),
                http=guarded_protocol(settings),
                ws="none",
                lifespan="off",
                access_log=False,
                log_config=None,
                server_header=False,
                timeout_graceful_shutdown=max(1, round(settings.drain_s)),
            )
        )
        serving = asyncio.create_task(http_server.serve(sockets=[http_socket]))
        addresses = Addresses(
            f"{settings.http_host}:{http_socket.getsockname()[1]}",
            f"{settings.grpc_host}:{rpc_port}",
        )
        pool = service.pool.state()
        renderer = pool.renderer
        log.info(
            "ready",
            http=addresses.http,
            grpc=addresses.grpc,
            local_socket=None if settings.local_socket is None else str(settings.local_socket),
            renderer=renderer.name if renderer else None,
            device=renderer.device if renderer else None,
            hardware=renderer.hardware if renderer else None,
            workers=len(pool.workers),
            model=service.model.name,
            role=service.role,
        )
        if on_ready is not None:
            on_ready(addresses)
        stopping = asyncio.create_task(stop.wait())
        await asyncio.wait({serving, stopping}, return_when=asyncio.FIRST_COMPLETED)
        await _drain(service, settings, http_server, serving, rpc_server)
    finally:
        http_socket.close()
        if listener is not None:
            listener.close()
        await service.close(0.0)


async def _drain(
    service: Service,
    settings: Settings,
    http_server: uvicorn.Server,
    serving: asyncio.Task[None],
    rpc_server: grpc.aio.Server,
) -> None:
    log.info("draining", grace_s=settings.drain_s, active=service.admission.active)
    finished = await service.admission.drain(settings.drain_s)
    http_server.should_exit = True
    await asyncio.gather(rpc_server.stop(1.0), serving)
    log.info("stopped", finished=finished)


def _bound_socket(host: str, port: int) -> socket.socket:
    """A listening socket, so that a taken address is known before anything else is started."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=2048)
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else str(error)
        raise OSError(error.errno, f"HTTP cannot listen on {host}:{port}: {reason}") from error


def _handle_signals(stop: asyncio.Event) -> None:
    loop = asyncio.get_running_loop()

    def on_signal() -> None:
        if stop.is_set():
            os._exit(1)
        stop.set()

    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, on_signal)
