"""The service behind HAProxy and Envoy, with the configurations of deploy/."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import grpc
import numpy as np
import pytest
import yaml
from grpc_health.v1 import health_pb2, health_pb2_grpc

import unbend
from benchmarks.proxies import ENVOY, HAPROXY, PROXIES, Proxy
from tests.acceptance.conftest import Server
from tests.companions import started
from unbend_service.settings import Settings

IDLE_S = Settings.model_fields["stream_idle_s"].default


@pytest.fixture(scope="module", params=sorted(PROXIES))
def proxy(request: pytest.FixtureRequest, server: Server, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Proxy]:
    """A proxy before the service of the session."""
    ports = int(server.grpc.rpartition(":")[2]), int(server.http.rpartition(":")[2])
    running = started(lambda: PROXIES[request.param](tmp_path_factory.mktemp("proxy"), [ports]))
    end = time.monotonic() + 30
    while running.healthy() != 1:
        assert time.monotonic() < end, "the proxy does not see the service"
        time.sleep(0.1)
    yield running
    running.stop()


def test_large_bodies_and_large_frames_pass(proxy: Proxy) -> None:
    """There is no bound on bodies in the proxy: a picture of megabytes and raw 1080p frames come back whole."""
    noise = np.random.default_rng(1).integers(0, 256, (1200, 1600, 3), np.uint8)
    with unbend.Client(f"127.0.0.1:{proxy.grpc_port}", timeout_s=120) as client:
        corrected = client.correct(noise, fit="keep")
        assert corrected.image.shape == noise.shape
        flat = np.full(1920 * 1080 * 3 // 2, 90, np.uint8)
        with client.stream(1920, 1080, "i420") as stream:
            results = list(stream.correct(flat for _ in range(12)))
        assert [result.index for result in results] == list(range(12))
    header = f"P6 {noise.shape[1]} {noise.shape[0]} 255\n".encode()
    request = urllib.request.Request(f"http://127.0.0.1:{proxy.http_port}/v1/grids", header + noise.tobytes())
    request.add_header("Content-Type", "application/json")
    with pytest.raises(urllib.error.HTTPError) as caught:
        urllib.request.urlopen(request, timeout=120)
    assert b"urn:unbend:error:" in caught.value.read()  # the service has read all of it, and answers itself
    caught.value.close()


def test_health_is_seen_through_the_proxy(proxy: Proxy) -> None:
    """HTTP readiness and gRPC health are those of the service."""
    with urllib.request.urlopen(f"http://127.0.0.1:{proxy.http_port}/readyz", timeout=30) as answer:
        assert answer.status == 200
    with grpc.insecure_channel(f"127.0.0.1:{proxy.grpc_port}") as channel:
        health = health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest(), timeout=30)
    assert health.status == health_pb2.HealthCheckResponse.SERVING


@pytest.mark.parametrize(
    "chosen",
    [
        {"UNBEND_DNS": "localhost"},
        {"UNBEND_1": "127.0.0.1", "UNBEND_1_GRPC_PORT": "50051", "UNBEND_1_HTTP_PORT": "8080"},
    ],
)
def test_haproxy_accepts_its_configuration(chosen: dict[str, str]) -> None:
    """Both ways of naming the replicas are valid; time-outs are above the idle time of streams."""
    found = shutil.which("haproxy", path="/usr/sbin:/usr/bin:/usr/local/sbin")
    if found is None:
        pytest.skip("haproxy is not installed")
    checked = subprocess.run([found, "-c", "-f", HAPROXY], env=chosen, capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stderr
    assert "WARNING" not in checked.stderr
    times = dict(re.findall(r"timeout (client|server) +(\d+)s", HAPROXY.read_text()))
    assert all(float(times[side]) > IDLE_S for side in ("client", "server"))
    assert "http-buffer-request" not in re.sub(r"#.*", "", HAPROXY.read_text())


def test_envoy_accepts_its_configuration() -> None:
    """Envoy itself validates it; streams have no total time, and their idle time is above that of the service."""
    found = Path(sys.executable).parent / "envoy"
    if not found.exists():
        pytest.skip("envoy is not installed")
    command = [str(found), "--mode", "validate", "-c", str(ENVOY), "--use-dynamic-base-id"]
    checked = subprocess.run(command, capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stderr
    listeners = yaml.safe_load(ENVOY.read_text())["static_resources"]["listeners"]
    manager = listeners[0]["filter_chains"][0]["filters"][0]["typed_config"]
    route = manager["route_config"]["virtual_hosts"][0]["routes"][0]["route"]
    assert route["timeout"] == "0s"
    assert min(float(each.rstrip("s")) for each in (route["idle_timeout"], manager["stream_idle_timeout"])) > IDLE_S
    assert not [each for each in manager["http_filters"] if "buffer" in each["name"]]
