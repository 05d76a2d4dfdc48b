"""A real Prometheus that scrapes one address every second, with the rules of this repository."""

from __future__ import annotations

import json
import math
import socket
import subprocess
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

RULES = Path(__file__).parent.parent / "prometheus/rules"


@dataclass(frozen=True, slots=True)
class Prometheus:
    """Where it listens, host:port."""

    address: str

    def ask(self, path: str, **parameters: str) -> Any:
        """The ``data`` of one call of its API. Raises ValueError with its own words about a wrong query."""
        url = f"http://{self.address}/api/v1/{path}?{urllib.parse.urlencode(parameters)}"
        try:
            with urllib.request.urlopen(url, timeout=10) as answer:
                return json.load(answer)["data"]
        except urllib.error.HTTPError as error:
            raise ValueError(json.load(error)["error"]) from error

    def numbers(self, query: str) -> list[float]:
        """The values that a query has now, one a series; NaN and infinity are left out, as a panel shows neither."""
        values = (float(series["value"][1]) for series in self.ask("query", query=query)["result"])
        return [value for value in values if math.isfinite(value)]

    def metrics(self) -> set[str]:
        """The names of all series that it holds."""
        return set(self.ask("label/__name__/values"))


@contextmanager
def scraping(target: str, folder: Path, job: str = "unbend") -> Iterator[Prometheus]:
    """Runs Prometheus over ``target``, host:port, until the block ends; its data lie in ``folder``.

    Raises:
        FileNotFoundError: there is no Prometheus on this machine.
        RuntimeError: it does not start.
    """
    configuration = {
        "global": {"scrape_interval": "1s", "evaluation_interval": "1s"},
        "rule_files": [f"{RULES}/*.yml"],
        "scrape_configs": [{"job_name": job, "static_configs": [{"targets": [target]}]}],
    }
    (folder / "prometheus.yml").write_text(json.dumps(configuration))  # JSON is YAML
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"127.0.0.1:{taken.getsockname()[1]}"
    log = folder / "prometheus.log"
    with log.open("w") as lines:
        process = subprocess.Popen(
            [
                "prometheus",
                f"--config.file={folder}/prometheus.yml",
                f"--storage.tsdb.path={folder}/data",
                f"--web.listen-address={address}",
            ],
            stdout=lines,
            stderr=subprocess.STDOUT,
        )
    try:
        _wait_until_ready(process, address, log)
        yield Prometheus(address)
    finally:
        process.terminate()
        process.wait(20)


def _wait_until_ready(process: subprocess.Popen[bytes], address: str, log: Path) -> None:
    deadline = time.monotonic() + 30
    while process.poll() is None and time.monotonic() < deadline:
        try:
            urllib.request.urlopen(f"http://{address}/-/ready", timeout=2).close()
            return
        except OSError:
            time.sleep(0.1)
    raise RuntimeError(f"Prometheus did not start:\n{log.read_text()}")
