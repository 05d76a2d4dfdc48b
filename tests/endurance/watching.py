"""The service seen from outside: its processes, its memory, its descriptors, and what it says of itself."""

from __future__ import annotations

import json
import os
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import psutil

from benchmarks.serving import Served, scraped


@dataclass(frozen=True)
class Watched:
    """A running service."""

    served: Served

    @property
    def process(self) -> psutil.Process:
        return psutil.Process(self.served.pid)

    def workers(self) -> list[psutil.Process]:
        """Render workers that live and have started; deputies are none."""
        found = []
        for child in self.process.children():
            try:
                if child.status() != psutil.STATUS_ZOMBIE and child.name().startswith("unbend-render"):
                    found.append(child)
            except psutil.NoSuchProcess:
                continue
        return found

    def readiness(self) -> dict[str, Any]:
        """The JSON of /readyz, whether it is ready or not."""
        try:
            with urllib.request.urlopen(f"http://{self.served.http}/readyz", timeout=10) as answer:
                return dict(json.load(answer))
        except urllib.error.HTTPError as error:
            return dict(json.load(error))

    def workers_ready(self) -> int:
        return sum(worker["state"] in ("ready", "busy") for worker in self.readiness()["workers"])

    def metric(self, name: str, **labels: str) -> float:
        """Sum of the samples of one metric whose labels contain ``labels``."""
        return scraped(self.served.http, name, **labels)

    def descriptors(self) -> int:
        return self.process.num_fds()

    def shared_bytes(self) -> int:
        """Memory of the slots for frames, which the parent owns."""
        total = 0
        base = f"/proc/{self.served.pid}/fd"
        for name in os.listdir(base):
            try:
                if "unbend-slot" in os.readlink(f"{base}/{name}"):
                    total += os.stat(f"{base}/{name}").st_size
            except FileNotFoundError:
                continue
        return total


def wait_for(condition: Callable[[], bool], patience_s: float) -> bool:
    """Whether ``condition`` came true within ``patience_s``."""
    end = time.monotonic() + patience_s
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.05)
    return True
