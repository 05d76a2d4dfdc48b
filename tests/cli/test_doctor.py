"""``unbend doctor``: each red line has its remedy, and the exit code says whether the service can work."""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
import sqlite3
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest

from benchmarks.companions import Companion
from unbend_service.adapters.estimators.cards import shipped_models
from unbend_service.cli.diagnosis import graphics, machine, packages, weights
from unbend_service.cli.diagnosis.finding import Finding
from unbend_service.settings import Settings

ROOT = Path(__file__).parent.parent.parent


def run(*arguments: str, **settings: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"UNBEND_HTTP_PORT": "0", "UNBEND_GRPC_PORT": "0", "COLUMNS": "200", **settings}
    return subprocess.run(
        [sys.executable, "-m", "unbend", "doctor", *arguments],
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_a_machine_that_can_serve_is_told_so_in_json() -> None:
    result = run("--json")
    report = json.loads(result.stdout)

    assert result.returncode == 0, result.stderr
    assert report["healthy"]
    names = {finding["name"] for finding in report["findings"]}
    assert names >= {"unbend", "packages", "cores", "memory", "EGL vendors", "EGL devices", "renderer", "model"}
    assert names >= {"HTTP port", "gRPC port", "grid store", "extra video"}
    assert all(finding["remedy"] for finding in report["findings"] if finding["status"] != "ok")


def test_what_is_broken_is_red_and_ends_the_command_with_one(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        result = run(
            UNBEND_MODEL=str(tmp_path / "no.onnx"),
            UNBEND_HTTP_PORT=port,
            UNBEND_GRID_STORE="sqlite",
            UNBEND_GRID_STORE_PATH=str(tmp_path / "no/grids.sqlite3"),
            UNBEND_RENDERER="cpu",
        )

    assert result.returncode == 1
    lines = result.stdout.splitlines()
    assert {line.split()[1] for line in lines if line.startswith("bad")} == {"model", "HTTP", "grid"}
    assert "set UNBEND_MODEL" in result.stdout
    assert "set UNBEND_HTTP_PORT" in result.stdout
    assert "set UNBEND_GRID_STORE_PATH" in result.stdout


def test_a_redis_that_answers_is_green_and_one_that_does_not_is_red(redis: Companion) -> None:
    settings = Settings(grid_store="redis", redis_url=f"redis://127.0.0.1:{redis.port}/0")
    assert machine.examine_grid_store(settings).status == "ok"
    away = machine.examine_grid_store(settings.model_copy(update={"redis_url": "redis://127.0.0.1:1/0"}))
    assert away.status == "bad"
    assert "UNBEND_REDIS_URL" in away.remedy


def test_without_turbojpeg_it_says_what_is_lost_and_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is a note: everything works without."""
    monkeypatch.setattr("unbend_service.adapters.codecs.planar_jpegs.LIBRARY", "libno-such-library.so.0")
    finding = packages.examine_turbojpeg()
    assert finding.status == "note"
    assert "libturbojpeg0" in finding.remedy


@pytest.fixture
def copied_model(tmp_path: Path) -> Path:
    name, source = next(iter(shipped_models().items()))
    for file in (source, source.with_suffix(".json")):
        shutil.copy(file, tmp_path)
    return tmp_path / f"{name}.onnx"


def test_a_model_that_is_as_its_card_says_is_fine(copied_model: Path) -> None:
    finding = weights.examine_model(Settings(model=str(copied_model)))

    assert finding.status == "ok"
    assert "as its card says" in finding.detail


def test_weights_that_are_not_those_of_their_card_are_found_out(copied_model: Path) -> None:
    with copied_model.open("ab") as file:
        file.write(b"\0")

    finding = weights.examine_model(Settings(model=str(copied_model)))

    assert (finding.status, bool(finding.remedy)) == ("bad", True)
    assert "not those of their card" in finding.detail


def test_weights_without_a_card_are_refused(copied_model: Path) -> None:
    copied_model.with_suffix(".json").unlink()

    assert weights.examine_model(Settings(model=str(copied_model))).status == "bad"


BLOCKED = """
import sys

class Wall:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            raise {error}

sys.meta_path.insert(0, Wall())
sys.modules.pop({module!r}, None)
from unbend_service.cli.diagnosis.packages import examine_extras

for finding in examine_extras():
    print(finding.status, finding.name, finding.detail, finding.remedy, sep="|")
"""


def extras_without(module: str, error: str) -> dict[str, list[str]]:
    code = BLOCKED.format(module=module, error=error)
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    return {name: [status, detail, remedy] for status, name, detail, remedy in map(split, result.stdout.splitlines())}


def split(line: str) -> list[str]:
    return line.split("|")


def test_a_missing_extra_is_named_with_what_it_is_for_and_how_to_get_it() -> None:
    found = extras_without("av", "ModuleNotFoundError(\"No module named 'av'\", name='av')")

    status, detail, remedy = found["extra video"]
    assert status == "note"
    assert "unbend video" in detail
    assert remedy == "pip install 'unbend[video]'"


def test_an_extra_whose_namespace_another_package_fills_is_missing_all_the_same() -> None:
    found = extras_without(
        "opentelemetry.sdk", "ModuleNotFoundError(\"No module named 'opentelemetry.sdk'\", name='opentelemetry.sdk')"
    )

    assert found["extra otel"][1] == "not installed; needed for traces"


def test_an_extra_that_is_there_and_does_not_load_is_not_called_installed() -> None:
    found = extras_without("OpenEXR", "ImportError('libImath.so: cannot open shared object file')")

    status, detail, _ = found["extra export"]
    assert status == "note"
    assert "libImath.so" in detail


def test_every_extra_of_the_distribution_is_looked_for() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]

    assert set(packages.EXTRAS) == set(extras) - {"service"}
    for name, extra in packages.EXTRAS.items():
        assert any(re.match(rf"{extra.distribution}\b", requirement) for requirement in extras[name])


def test_a_port_that_another_program_has_is_red() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        for finding in (
            machine.examine_http_port(Settings(http_port=port)),
            machine.examine_grpc_port(Settings(grpc_port=port)),
        ):
            assert finding.status == "bad"
            assert "taken" in finding.detail
            assert finding.remedy.endswith("_PORT")


def test_a_port_on_an_address_of_another_machine_names_the_setting_of_the_host() -> None:
    finding = machine.examine_http_port(Settings(http_host="192.0.2.1", http_port=8080))

    assert finding.status == "bad"
    assert "UNBEND_HTTP_HOST" in finding.remedy


def store(path: Path) -> Finding:
    return machine.examine_grid_store(Settings(grid_store="sqlite", grid_store_path=path))


def test_a_grid_store_that_can_be_made_or_is_there_is_fine(tmp_path: Path) -> None:
    path = tmp_path / "grids.sqlite3"
    assert store(path).status == "ok"
    assert not path.exists()
    connection = sqlite3.connect(path)
    connection.execute("CREATE TABLE grids (id TEXT)")
    connection.close()
    assert store(path).status == "ok"


def test_a_grid_store_that_cannot_be_used_is_red_with_its_remedy(tmp_path: Path) -> None:
    (tmp_path / "text.sqlite3").write_text("This is no database, and long enough to be told from one." * 20)

    for path in (tmp_path, tmp_path / "no/grids.sqlite3", tmp_path / "text.sqlite3"):
        finding = store(path)
        assert finding.status == "bad", path
        assert finding.remedy


def machine_with(root: Path, available_kib: int, limit: str, used: int) -> Path:
    (root / "proc").mkdir(parents=True)
    (root / "sys/fs/cgroup").mkdir(parents=True)
    (root / "proc/meminfo").write_text(f"MemTotal: 99999999 kB\nMemAvailable: {available_kib} kB\n")
    (root / "sys/fs/cgroup/memory.max").write_text(f"{limit}\n")
    (root / "sys/fs/cgroup/memory.current").write_text(f"{used}\n")
    return root


def test_the_memory_limit_of_a_container_counts(tmp_path: Path) -> None:
    free = machine_with(tmp_path / "free", 8 << 20, "max", 1 << 30)
    tight = machine_with(tmp_path / "tight", 8 << 20, str(512 << 20), 256 << 20)

    assert machine.available_bytes(free) == 8 << 30
    assert machine.available_bytes(tight) == 256 << 20
    finding = machine.examine_memory(Settings(), tight)
    assert finding.status == "note"
    assert "UNBEND_SHARED_MEMORY_BYTES" in finding.remedy


def test_a_driver_that_crashes_or_hangs_is_an_error_and_the_next_question_is_answered() -> None:
    with graphics.Sandbox() as sandbox:
        with pytest.raises(OSError, match="crashed"):
            sandbox.ask(os.abort)
        with pytest.raises(OSError, match="did not answer"):
            sandbox.ask(time.sleep, 60, timeout_s=0.2)
        with pytest.raises(OSError, match=r"no-such-library"):
            sandbox.ask(graphics._load, "no-such-library.so")
        assert sandbox.ask(abs, -42) == 42


def graphics_of(root: Path, **settings: object) -> dict[str, Finding]:
    return {finding.name: finding for finding in graphics.examine_graphics(Settings(**settings), root)}


def test_a_vendor_file_whose_library_is_missing_is_named(tmp_path: Path) -> None:
    folder = tmp_path / "usr/share/glvnd/egl_vendor.d"
    folder.mkdir(parents=True)
    (folder / "10_ghost.json").write_text('{"ICD": {"library_path": "libEGL_ghost.so.0"}}')
    (folder / "20_torn.json").write_text("{")

    finding = graphics_of(tmp_path, renderer="cpu")["EGL vendors"]

    assert finding.status == "note"
    assert "libEGL_ghost.so.0" in finding.detail
    assert "10_ghost.json, 20_torn.json" in finding.remedy


def test_an_nvidia_card_without_its_egl_driver_names_the_variable_of_the_container(tmp_path: Path) -> None:
    (tmp_path / "dev").mkdir()
    (tmp_path / "dev/nvidiactl").touch()

    assert "NVIDIA_DRIVER_CAPABILITIES" in graphics_of(tmp_path, renderer="cpu")["EGL vendors"].remedy


@pytest.mark.egl
def test_a_software_renderer_is_red_only_where_a_gpu_is_required() -> None:
    asked = graphics_of(Path("/"), require_gpu=True)["renderer"]
    if "software" not in asked.detail:
        pytest.skip("there is a GPU here")
    free = graphics_of(Path("/"))

    assert asked.status == "bad"
    assert "UNBEND_REQUIRE_GPU" in asked.remedy or "NVIDIA" in asked.remedy
    assert free["renderer"].status == "ok"
    assert free["EGL devices"].status == "ok"


@pytest.mark.egl
def test_a_device_that_is_not_there_names_those_that_are() -> None:
    finding = graphics_of(Path("/"), egl_device=200, renderer="cpu")["EGL devices"]

    assert finding.status == "note"
    assert "UNBEND_EGL_DEVICE to 0" in finding.remedy
