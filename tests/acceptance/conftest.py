from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass, field

import psutil
import pytest

from benchmarks.serving import scraped


@dataclass
class Server:
    """A real ``unbend serve`` on free ports.

    Attributes:
        http, grpc: host:port; ops, of health and metrics, if they are apart.
        lines: what it has logged so far, parsed.
    """

    process: subprocess.Popen[str]
    lines: list[dict[str, object]] = field(default_factory=list)
    http: str = ""
    grpc: str = ""
    ops: str = ""

    def metric(self, name: str, **labels: str) -> float:
        """Sum of the samples of one metric whose labels contain ``labels``."""
        return scraped(self.http, name, **labels)

    def get(self, path: str) -> bytes:
        with urllib.request.urlopen(f"http://{self.http}{path}", timeout=30) as answer:
            return bytes(answer.read())

    def workers(self) -> list[psutil.Process]:
        """The render worker processes that live, as the log names them."""
        pids = {entry["pid"] for entry in self.lines if entry["event"] == "render worker ready"}
        children = psutil.Process(self.process.pid).children(recursive=True)
        return [child for child in children if child.pid in pids and child.status() != psutil.STATUS_ZOMBIE]


def start_server(*, before: tuple[str, ...] = (), **settings: str) -> Server:
    """Starts ``unbend serve`` and waits until it says that it is ready; ``before`` is a command that executes it.

    It has one render worker and one decoder unless the settings say otherwise: each takes half a second to start.
    """
    environment = os.environ | {
        "UNBEND_HTTP_PORT": "0",
        "UNBEND_GRPC_PORT": "0",
        "UNBEND_LOG_FORMAT": "json",
        **{f"UNBEND_{name.upper()}": value for name, value in ({"workers": "1", "decoders": "1"} | settings).items()},
    }
    process = subprocess.Popen(
        [*before, sys.executable, "-m", "unbend", "serve"], env=environment, stderr=subprocess.PIPE, text=True
    )
    server = Server(process)
    ready = threading.Event()

    def read() -> None:
        assert process.stderr is not None
        for line in process.stderr:
            entry = json.loads(line) if line.startswith("{") else {"event": line}
            server.lines.append(entry)
            if entry["event"] == "ready":
                server.http, server.grpc, server.ops = str(entry["http"]), str(entry["grpc"]), str(entry["ops"] or "")
                ready.set()

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    deadline = time.monotonic() + 120
    while not ready.wait(0.1):
        if process.poll() is not None or time.monotonic() > deadline:
            process.kill()
            reader.join()
            assert process.stderr is not None
            process.stderr.close()
            raise AssertionError(f"the service did not start: {server.lines}")
    return server


def stop_server(server: Server) -> int:
    """Asks the service to stop and returns its exit status."""
    if server.process.poll() is None:
        server.process.send_signal(signal.SIGTERM)
    try:
        return server.process.wait(30)
    finally:
        server.process.kill()
        if server.process.stderr is not None:
            server.process.stderr.close()
        server.process.wait(5)


def shared_memory_names() -> set[str]:
    """Entries of /dev/shm, but for those that other programs have there meanwhile: Envoy's, and multiprocessing's."""
    return {name for name in os.listdir("/dev/shm") if not name.startswith(("envoy_shared_memory", "sem.mp-"))}


@pytest.fixture(scope="session")
def server() -> Iterator[Server]:
    """One service for every test that does not need its own."""
    running = start_server(workers="2", decoders="2")
    yield running
    assert stop_server(running) == 0
