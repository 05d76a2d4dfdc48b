"""An installation on one machine: replicas of the service, Redis, and a proxy with its configuration of deploy/."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil

from benchmarks.companions import Companion, free_port, redis_server
from benchmarks.proxies import PROXIES, Proxy
from benchmarks.serving import scraped

_START_S = 120.0

#: One worker and one thread each: replicas share the cores of one machine here.
_SETTINGS = {
    "HTTP_PORT": "0",
    "RENDERER": "cpu",
    "WORKERS": "1",
    "ESTIMATOR_THREADS": "1",
    "LOG_FORMAT": "json",
    "DRAIN_S": "20",
}


class Replica:
    """One ``unbend serve`` that keeps its ports over restarts."""

    def __init__(self, name: str, settings: dict[str, str]) -> None:
        self.name = name
        self.http_port, self.grpc_port = free_port(), free_port()
        ports = {"HTTP_PORT": str(self.http_port), "GRPC_PORT": str(self.grpc_port)}
        chosen = _SETTINGS | settings | ports
        self._environment = os.environ | {f"UNBEND_{key}": value for key, value in chosen.items()}
        self._process: subprocess.Popen[str] | None = None
        self._ready = threading.Event()

    def start(self) -> None:
        """Starts the process; :meth:`wait_ready` waits for it."""
        command = [sys.executable, "-m", "unbend", "serve"]
        self._ready.clear()
        self._process = subprocess.Popen(command, env=self._environment, stderr=subprocess.PIPE, text=True)
        threading.Thread(target=self._read, args=(self._process,), daemon=True).start()

    def wait_ready(self) -> None:
        """Raises RuntimeError unless it serves in time."""
        if not self._ready.wait(_START_S):
            raise RuntimeError(f"{self.name} did not start")

    @property
    def process(self) -> psutil.Process:
        assert self._process is not None
        return psutil.Process(self._process.pid)

    def cpu_s(self) -> float:
        """Processor time that the replica and its workers have taken."""
        times = [process.cpu_times() for process in (self.process, *self.process.children(recursive=True))]
        return float(sum(each.user + each.system for each in times))

    def metric(self, name: str, **labels: str) -> float:
        """Sum of the samples of one metric whose labels contain ``labels``."""
        return scraped(f"127.0.0.1:{self.http_port}", name, **labels)

    def kill(self) -> None:
        """Ends it and its workers as a failure of the machine would."""
        assert self._process is not None
        with contextlib.suppress(psutil.NoSuchProcess):
            family = [self.process, *self.process.children(recursive=True)]
            for process in family:
                with contextlib.suppress(psutil.NoSuchProcess):
                    process.kill()
        self._process.wait()

    def drain(self) -> int:
        """Ends it with SIGTERM; its exit status."""
        assert self._process is not None
        self._process.send_signal(signal.SIGTERM)
        return self._process.wait(60)

    def stop(self) -> None:
        """Ends it, whatever state it is in."""
        if self._process is None or self._process.poll() is not None:
            return
        try:
            self.drain()
        except subprocess.TimeoutExpired:
            self.kill()

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stderr is not None
        with process.stderr as lines:
            for line in lines:
                entry = json.loads(line) if line.startswith("{") else {}
                if entry.get("event") == "ready":
                    self._ready.set()


class Cluster:
    """Replicas behind a proxy, sharing Redis."""

    def __init__(self, replicas: list[Replica], redis: Companion, proxy: Proxy) -> None:
        self.replicas = replicas
        self.redis = redis
        self.proxy = proxy

    @property
    def grpc(self) -> str:
        """host:port that clients use."""
        return f"127.0.0.1:{self.proxy.grpc_port}"

    def wait_routed(self, count: int) -> None:
        """Waits until the proxy sends calls to ``count`` replicas. Raises RuntimeError after a while."""
        end = time.monotonic() + 30
        while self.proxy.healthy() != count:
            if time.monotonic() > end:
                raise RuntimeError(f"the proxy does not see {count} replicas")
            time.sleep(0.1)


@contextmanager
def running(count: int, kind: str = "haproxy", **settings: str) -> Iterator[Cluster]:
    """``count`` replicas (1..4) behind ``kind`` (haproxy or envoy), ready and routed to; all is ended afterwards."""
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as ends:
        redis = redis_server(Path(folder))
        ends.callback(redis.stop)
        shared = {"GRID_STORE": "redis", "REDIS_URL": f"redis://127.0.0.1:{redis.port}/0"}
        replicas = [Replica(f"replica {i + 1}", shared | settings) for i in range(count)]
        for replica in replicas:
            ends.callback(replica.stop)
            replica.start()
        for replica in replicas:
            replica.wait_ready()
        proxy = PROXIES[kind](Path(folder), [(replica.grpc_port, replica.http_port) for replica in replicas])
        ends.callback(proxy.stop)
        cluster = Cluster(replicas, redis, proxy)
        cluster.wait_routed(count)
        yield cluster
