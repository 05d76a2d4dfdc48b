"""A real ``unbend serve`` in processes of its own, for the suites that measure it from outside."""

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
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Served:
    """Where it listens, host:port, and how long it took.

    Attributes:
        ready_s: from the start of the process to its line that it is ready.
        pid: of the parent process.
    """

    http: str
    grpc: str
    ready_s: float
    pid: int


def scraped(http: str, name: str, **labels: str) -> float:
    """Sum of the samples of one metric of the service at ``http``, host:port, whose labels contain ``labels``."""
    with urllib.request.urlopen(f"http://{http}/metrics", timeout=30) as answer:
        lines = answer.read().decode().splitlines()
    total = 0.0
    for line in lines:
        head, _, value = line.rpartition(" ")
        if head.split("{")[0] == name and all(f'{key}="{text}"' in head for key, text in labels.items()):
            total += float(value)
    return total


@contextmanager
def served(**settings: object) -> Iterator[Served]:
    """Starts the service on free ports and stops it afterwards."""
    environment = os.environ | {"UNBEND_HTTP_PORT": "0", "UNBEND_GRPC_PORT": "0", "UNBEND_LOG_FORMAT": "json"}
    environment |= {f"UNBEND_{name.upper()}": str(value) for name, value in settings.items()}
    start = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "unbend", "serve"], env=environment, stderr=subprocess.PIPE, text=True
    )
    assert process.stderr is not None
    try:
        for line in process.stderr:
            entry = json.loads(line) if line.startswith("{") else {}
            if entry.get("event") == "ready":
                ready_s = time.perf_counter() - start
                break
        else:
            raise RuntimeError("the service did not start")
        threading.Thread(target=process.stderr.read, daemon=True).start()  # so that the pipe never fills
        yield Served(str(entry["http"]), str(entry["grpc"]), ready_s, process.pid)
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(30)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        process.stderr.close()
