"""HAProxy and Envoy before replicas on this machine, with the configurations of deploy/."""

from __future__ import annotations

import os
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import yaml

from benchmarks.companions import Companion, free_port

DEPLOY = Path(__file__).parent.parent / "deploy"
HAPROXY = DEPLOY / "haproxy" / "haproxy.cfg"
ENVOY = DEPLOY / "envoy" / "envoy.yaml"


class Proxy(Protocol):
    """A proxy with its ports on 127.0.0.1."""

    grpc_port: int
    http_port: int

    def healthy(self) -> int:
        """Replicas that gRPC calls are sent to."""
        ...

    def stop(self) -> None: ...


class HaProxy(Companion):
    """HAProxy; replicas are given as (gRPC port, HTTP port)."""

    def __init__(self, folder: Path, replicas: list[tuple[int, int]]) -> None:
        self.grpc_port, self.http_port, self._stats_port = free_port(), free_port(), free_port()
        ports = {"GRPC_PORT": self.grpc_port, "HTTP_PORT": self.http_port, "STATS_PORT": self._stats_port}
        environment = os.environ | {"BIND_ADDRESS": "127.0.0.1"} | {name: str(port) for name, port in ports.items()}
        for i, (grpc_port, http_port) in enumerate(replicas, 1):
            environment[f"UNBEND_{i}"] = "127.0.0.1"
            environment[f"UNBEND_{i}_GRPC_PORT"] = str(grpc_port)
            environment[f"UNBEND_{i}_HTTP_PORT"] = str(http_port)
        super().__init__(["haproxy", "-db", "-f", str(HAPROXY)], self.grpc_port, folder / "haproxy.log", environment)

    def healthy(self) -> int:
        up = [line for line in _lines(self._stats_port, "/metrics") if line.startswith("haproxy_server_status{")]
        mine = [line for line in up if 'proxy="grpc"' in line and 'state="UP"' in line]
        return sum(float(line.rpartition(" ")[2]) == 1 for line in mine)


class Envoy(Companion):
    """Envoy; replicas are given as (gRPC port, HTTP port)."""

    def __init__(self, folder: Path, replicas: list[tuple[int, int]]) -> None:
        self.grpc_port, self.http_port, self._admin_port = free_port(), free_port(), free_port()
        configuration = yaml.safe_load(ENVOY.read_text())
        configuration["admin"]["address"] = _address(self._admin_port)
        listening = {"grpc": self.grpc_port, "http": self.http_port}
        for listener in configuration["static_resources"]["listeners"]:
            listener["address"] = _address(listening[listener["name"]])
        for place, cluster in enumerate(configuration["static_resources"]["clusters"]):
            endpoints = [{"endpoint": {"address": _address(ports[place])}} for ports in replicas]
            cluster["load_assignment"]["endpoints"] = [{"lb_endpoints": endpoints}]
        file = folder / "envoy.yaml"
        file.write_text(yaml.safe_dump(configuration))
        command = ["envoy", "-c", str(file), "--use-dynamic-base-id", "--concurrency", "2", "--log-level", "warning"]
        super().__init__(command, self.grpc_port, folder / "envoy.log")

    def healthy(self) -> int:
        lines = _lines(self._admin_port, "/stats?filter=cluster.grpc.membership_healthy")
        return int(lines[0].rpartition(" ")[2]) if lines else 0


PROXIES: dict[str, Callable[[Path, list[tuple[int, int]]], Proxy]] = {"haproxy": HaProxy, "envoy": Envoy}


def _address(port: int) -> dict[str, Any]:
    return {"socket_address": {"address": "127.0.0.1", "port_value": port}}


def _lines(port: int, path: str) -> list[str]:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=10) as answer:
        return str(answer.read().decode()).splitlines()
