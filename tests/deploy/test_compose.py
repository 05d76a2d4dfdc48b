"""The compose file, read by Docker Compose itself; and what it mounts, read by what it is for."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from unbend_service.settings import Settings

pytestmark = pytest.mark.deploy

COMPOSE = Path(__file__).parent.parent.parent / "deploy/compose"
DOCKER_COMPOSE = Path(sys.executable).parent / "docker-compose"


def configuration(*names: str) -> dict[str, Any]:
    files = [word for name in names for word in ("-f", str(COMPOSE / name))]
    done = subprocess.run(
        [DOCKER_COMPOSE, *files, "config", "--format", "json"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "warning" not in done.stderr, done.stderr
    return dict(json.loads(done.stdout))


@pytest.fixture(scope="module")
def services() -> dict[str, Any]:
    return dict(configuration("compose.yaml")["services"])


def test_compose_takes_the_file_and_finds_all_five_services(services: dict[str, Any]) -> None:
    assert services.keys() == {"unbend", "redis", "haproxy", "prometheus", "grafana"}


def test_a_file_that_compose_does_not_understand_is_found(tmp_path: Path) -> None:
    wrong = tmp_path / "compose.yaml"
    wrong.write_text((COMPOSE / "compose.yaml").read_text().replace("read_only:", "readonly:"))
    done = subprocess.run([DOCKER_COMPOSE, "-f", wrong, "config", "-q"], capture_output=True, check=False)
    assert done.returncode != 0


def test_what_is_mounted_is_there(services: dict[str, Any]) -> None:
    mounts = [mount for service in services.values() for mount in service.get("volumes", ()) if mount["type"] == "bind"]
    assert mounts
    for mount in mounts:
        assert Path(mount["source"]).exists(), mount


def test_nothing_is_published_beyond_this_machine(services: dict[str, Any]) -> None:
    for name, service in services.items():
        assert all(port["host_ip"] == "127.0.0.1" for port in service.get("ports", ())), name
    assert not services["unbend"].get("ports")


def test_the_service_has_the_rights_it_needs_and_no_more(services: dict[str, Any]) -> None:
    unbend = services["unbend"]
    assert unbend["read_only"] is True
    assert unbend["cap_drop"] == ["ALL"]
    assert "no-new-privileges:true" in unbend["security_opt"]


def test_the_service_is_given_longer_than_its_drain(services: dict[str, Any]) -> None:
    notice = float(Settings.model_fields["drain_notice_s"].default)
    drain = notice + float(services["unbend"]["environment"]["UNBEND_DRAIN_S"])
    assert float(services["unbend"]["stop_grace_period"].removesuffix("s")) > drain + 5


def test_the_environment_names_settings_that_exist(services: dict[str, Any]) -> None:
    given = {name.removeprefix("UNBEND_").lower(): value for name, value in services["unbend"]["environment"].items()}
    assert given.keys() <= Settings.model_fields.keys()
    Settings(**given)


def test_a_gpu_is_reserved_with_the_second_file() -> None:
    unbend = configuration("compose.yaml", "gpu.yaml")["services"]["unbend"]
    (device,) = unbend["deploy"]["resources"]["reservations"]["devices"]
    assert device["driver"] == "nvidia"
    assert "graphics" in device["capabilities"]
    assert unbend["environment"]["UNBEND_REQUIRE_GPU"] == "true"


@pytest.mark.skipif(shutil.which("haproxy") is None, reason="apt-get install haproxy")
def test_haproxy_takes_its_configuration_without_a_warning(services: dict[str, Any]) -> None:
    haproxy = services["haproxy"]
    (mount,) = haproxy["volumes"]
    done = subprocess.run(
        ["haproxy", "-c", "-f", mount["source"]],
        env=os.environ | haproxy["environment"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr, done.stderr
