from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import Future
from typing import Any

import cv2
import numpy as np
import pytest

import unbend
from tests.assembly import service_over_fakes
from tests.fakes import FakeRenderPool, RecordingMeter
from unbend_service.adapters.grid_stores.memory import MemoryGridStore
from unbend_service.settings import Settings
from unbend_service.transport.rpc.server import start_server


class LoopThread:
    """An event loop of its own, in a thread."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()

    def run(self, work: Coroutine[Any, Any, Any]) -> Any:
        future: Future[Any] = asyncio.run_coroutine_threadsafe(work, self._loop)
        return future.result(20)

    def call(self, function: Callable[[], object]) -> None:
        async def called() -> None:
            function()

        self.run(called())

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(10)
        self._loop.close()


class Server:
    """A gRPC server over fakes, in a thread, whose end can be sudden."""

    def __init__(self, store: MemoryGridStore | None = None, port: int = 0, **changed: object) -> None:
        values = {"grpc_port": port, "grid_points": 17, "stream_estimate_wait_s": 0.3, "body_bytes": 1 << 20}
        self.settings = Settings(**{**values, **changed})
        self._thread = LoopThread()
        self.service, self._server, self.port = self._thread.run(self._start(store))
        self._stopped = False

    async def _start(self, store: MemoryGridStore | None) -> tuple[Any, Any, int]:
        service = service_over_fakes(self.settings, store)
        server, port = await start_server(service, self.settings)
        return service, server, port

    @property
    def target(self) -> str:
        return f"127.0.0.1:{self.port}"

    @property
    def meter(self) -> RecordingMeter:
        assert isinstance(self.service.meter, RecordingMeter)
        return self.service.meter

    @property
    def pool(self) -> FakeRenderPool:
        assert isinstance(self.service.pool, FakeRenderPool)
        return self.service.pool

    def drain(self) -> None:
        """Refuses new calls; streams end after what they accepted."""
        self._thread.run(self.service.admission.drain(5.0))

    def stop(self) -> None:
        """Ends at once, whatever is under way."""
        if not self._stopped:
            self._stopped = True
            self._thread.run(self._server.stop(0))
            self._thread.run(self.service.close(0))
            self._thread.close()


class Wire:
    """A TCP relay to a server, that can be cut."""

    def __init__(self, port: int) -> None:
        self._to = port
        self._thread = LoopThread()
        self._writers: set[asyncio.StreamWriter] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self.connections = 0
        self._server = self._thread.run(asyncio.start_server(self._relay, "127.0.0.1", 0))
        self.target = f"127.0.0.1:{self._server.sockets[0].getsockname()[1]}"

    async def _relay(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        there = await asyncio.open_connection("127.0.0.1", self._to)
        self._writers |= {writer, there[1]}
        await asyncio.gather(self._pump(reader, there[1]), self._pump(there[0], writer))

    async def _pump(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            while data := await reader.read(1 << 16):
                writer.write(data)
                await writer.drain()
        writer.close()

    def cut(self) -> None:
        """Breaks every connection, without a goodbye."""

        def abort() -> None:
            for writer in self._writers:
                writer.transport.abort()
            self._writers.clear()

        self._thread.call(abort)

    def close(self) -> None:
        self.cut()

        async def end() -> None:
            self._server.close()
            await self._server.wait_closed()
            await asyncio.sleep(0.05)

        self._thread.run(end())
        self._thread.close()


@pytest.fixture
def server() -> Iterator[Server]:
    running = Server()
    yield running
    running.stop()


@pytest.fixture
def client(server: Server) -> Iterator[unbend.Client]:
    with unbend.Client(server.target, timeout_s=10) as connected:
        yield connected


@pytest.fixture
def picture() -> np.ndarray:
    """(48, 64, 3) uint8, blocks."""
    blocks = np.random.default_rng(1).integers(0, 255, (6, 8, 3), dtype=np.uint8)
    return cv2.resize(blocks, (64, 48), interpolation=cv2.INTER_NEAREST)
