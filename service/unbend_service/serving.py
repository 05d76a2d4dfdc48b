"""The life of the service process: start, serve both transports, drain, stop."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import ssl
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

import grpc
import structlog
import uvicorn
from fastapi import FastAPI

from unbend_service.allocator import share_arenas
from unbend_service.application.service import Service
from unbend_service.exposure import check_exposure
from unbend_service.refreshing import refreshed
from unbend_service.resting import tended
from unbend_service.settings import Settings
from unbend_service.transport.local.listener import MemoryListener
from unbend_service.transport.rest.app import create_app, create_ops_app
from unbend_service.transport.rest.connections import guarded_protocol
from unbend_service.transport.rpc.server import start_server
from unbend_service.transport.tls import Certificates, read_certificates
from unbend_service.wiring import build_service

log = structlog.get_logger(__name__)

#: For the last bytes of answers that are ready, and for all that has to be freed after them.
_LAST_BYTES_S, _LAST_WORDS_S = 1, 8.0


@dataclass(frozen=True, slots=True)
class Addresses:
    """Where the service listens: host:port of each transport, with the ports that were really taken.

    Attributes:
        ops: of health and metrics, if they have a listener of their own.
    """

    http: str
    grpc: str
    ops: str | None = None


class _HttpServer(uvicorn.Server):
    """Uvicorn without its own signal handling: the process drains both transports together.

    Args:
        handshake_s: longest wait for a TLS handshake, for which uvicorn has no setting.
    """

    def __init__(self, config: uvicorn.Config, handshake_s: float) -> None:
        super().__init__(config)
        self._handshake_s = handshake_s

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """As uvicorn's, for sockets that are bound already and an application without a lifespan."""
        config, loop = self.config, asyncio.get_running_loop()
        protocol: Any = config.http_protocol_class

        def connected() -> asyncio.Protocol:
            made: asyncio.Protocol = protocol(config=config, server_state=self.server_state, app_state={}, _loop=loop)
            return made

        limit_s = None if config.ssl is None else self._handshake_s
        self.servers = [
            await loop.create_server(
                connected, sock=bound, backlog=config.backlog, ssl=config.ssl, ssl_handshake_timeout=limit_s
            )
            for bound in sockets or ()
        ]
        self.started = True

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


async def serve(settings: Settings, on_ready: Callable[[Addresses], None] | None = None) -> None:
    """Serves until SIGTERM or SIGINT, then drains; a second signal ends the process at once.

    SIGTERM comes from an orchestrator: readiness flips ``drain_notice_s`` before calls are refused. SIGINT comes from
    somebody at the keyboard, who does not wait for that.

    Raises:
        UnbendError: the service cannot start with these settings.
        OSError: an address is taken.
    """
    share_arenas()
    stop: asyncio.Future[signal.Signals] = asyncio.get_running_loop().create_future()
    _handle_signals(stop)
    for warning in check_exposure(settings):
        log.warning("exposed", message=warning)
    certificates = read_certificates(settings)
    with ExitStack() as held:
        http_socket = held.enter_context(_bound_socket(settings.http_host, settings.http_port))
        ops_socket = None
        if settings.ops_port is not None:
            ops_socket = held.enter_context(_bound_socket(settings.ops_host, settings.ops_port))
        await _serve(settings, stop, certificates, http_socket, ops_socket, on_ready)


async def _serve(
    settings: Settings,
    stop: asyncio.Future[signal.Signals],
    certificates: Certificates | None,
    http_socket: socket.socket,
    ops_socket: socket.socket | None,
    on_ready: Callable[[Addresses], None] | None,
) -> None:
    service = build_service(settings)
    listener: MemoryListener | None = None
    try:
        await service.start()
        rpc_server, rpc_port = await start_server(service, settings, certificates)
        if settings.local_socket is not None:
            listener = MemoryListener(settings.local_socket, service.regions, settings.streams)
            listener.start()
        app = create_app(service, settings)
        http_server = _http_server(app, settings, certificates.http() if certificates else None)
        serving = asyncio.create_task(http_server.serve(sockets=[http_socket]))
        ops_server = None
        if ops_socket is not None:
            ops_app = create_ops_app(service)
            ops_server = _http_server(ops_app, settings, certificates.ops() if certificates else None)
            ops_serving = asyncio.create_task(ops_server.serve(sockets=[ops_socket]))
        addresses = Addresses(
            f"{settings.http_host}:{http_socket.getsockname()[1]}",
            f"{settings.grpc_host}:{rpc_port}",
            f"{settings.ops_host}:{ops_socket.getsockname()[1]}" if ops_socket is not None else None,
        )
        pool = service.pool.state()
        renderer = pool.renderer
        log.info(
            "ready",
            http=addresses.http,
            grpc=addresses.grpc,
            ops=addresses.ops,
            tls=certificates is not None,
            tokens=service.access.required,
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
        ends: set[asyncio.Future[Any]] = {serving, stop}
        with refreshed(service.access, certificates), tended(lambda: service.admission.active):
            await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
            notice_s = settings.drain_notice_s if stop.done() and stop.result() == signal.SIGTERM else 0.0
            _end_at_last(notice_s + settings.drain_s + _LAST_WORDS_S)
            await _drain(service, settings, notice_s, http_server, serving, rpc_server)
        if ops_server is not None:  # probes were answered to the end
            ops_server.should_exit = True
            await ops_serving
    finally:
        if listener is not None:
            listener.close()
        await service.close(0.0)


def _http_server(app: FastAPI, settings: Settings, context: ssl.SSLContext | None) -> uvicorn.Server:
    return _HttpServer(
        uvicorn.Config(
            app,
            http=guarded_protocol(settings),
            ws="none",
            lifespan="off",
            access_log=False,
            log_config=None,
            server_header=False,
            timeout_graceful_shutdown=_LAST_BYTES_S,
            ssl_context_factory=None if context is None else lambda config, default: context,
        ),
        settings.handshake_s,
    )


async def _drain(
    service: Service,
    settings: Settings,
    notice_s: float,
    http_server: uvicorn.Server,
    serving: asyncio.Task[None],
    rpc_server: grpc.aio.Server,
) -> None:
    """Says that it goes, then refuses, then ends with the last accepted call or after ``drain_s``."""
    log.info("draining", notice_s=notice_s, grace_s=settings.drain_s, active=service.admission.active)
    service.admission.leave()
    await asyncio.sleep(notice_s)
    finished = await service.admission.drain(settings.drain_s)
    http_server.should_exit = True
    stopping = asyncio.ensure_future(rpc_server.stop(_LAST_BYTES_S))
    ends: set[asyncio.Future[Any]] = {stopping, serving}
    # the library may wait for a call that was cancelled at its deadline; nothing accepted is left by now
    _, left = await asyncio.wait(ends, timeout=_LAST_BYTES_S + 2)
    log.info("stopped", finished=finished, transports_left=len(left))


def _end_at_last(patience_s: float) -> None:
    """Ends the process in spite of a thread or a library that does not come back."""
    timer = threading.Timer(patience_s, os._exit, (1,))
    timer.daemon = True
    timer.start()


def _bound_socket(host: str, port: int) -> socket.socket:
    """A listening socket, so that a taken address is known before anything else is started."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=2048)
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else str(error)
        raise OSError(error.errno, f"HTTP cannot listen on {host}:{port}: {reason}") from error


def _handle_signals(stop: asyncio.Future[signal.Signals]) -> None:
    loop = asyncio.get_running_loop()

    def on_signal(number: signal.Signals) -> None:
        if stop.done():
            os._exit(1)
        stop.set_result(number)

    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, on_signal, number)
