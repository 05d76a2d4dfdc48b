"""``unbend doctor``."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from importlib import metadata
from importlib.util import find_spec
from multiprocessing import get_context
from typing import Annotated

import typer
from rich.table import Table

from unbend_service.adapters.cores import usable_cores
from unbend_service.adapters.estimators.catalogue import load_estimator
from unbend_service.adapters.renderers.egl import EglRenderer
from unbend_service.cli.reporting import EXIT_FAILED, console, print_json
from unbend_service.cli.serve import read_settings
from unbend_service.domain.errors import UnbendError
from unbend_service.settings import Settings

_EGL_REMEDY = (
    "install libegl1 and libgl1-mesa-dri (Debian) for the software path, or run with the NVIDIA driver's EGL "
    "(container: NVIDIA_DRIVER_CAPABILITIES=graphics,compute,utility); the cpu renderer works without"
)
_EXTRAS = {"video": "av"}


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the report.

    Attributes:
        status: ``ok``, ``note`` (works, could be better) or ``bad`` (the service will not work).
        remedy: what to do about it; empty when ok.
    """

    name: str
    status: str
    detail: str
    remedy: str = ""


def doctor(as_json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")] = False) -> None:
    """Say what this machine offers, what is missing, and how to mend it. Ends with 1 if the service cannot work."""
    findings = list(examine(read_settings()))
    healthy = all(finding.status != "bad" for finding in findings)
    if as_json:
        print_json({"healthy": healthy, "findings": [asdict(finding) for finding in findings]})
    else:
        _print(findings)
    if not healthy:
        raise typer.Exit(EXIT_FAILED)


def examine(settings: Settings) -> Iterator[Finding]:
    """Looks at versions, cores, EGL, the model, memory, ports and extras."""
    yield Finding("unbend", "ok", f"{metadata.version('unbend')} on Python {sys.version.split()[0]}")
    yield Finding("cores", "ok", f"{usable_cores()} usable of {os.cpu_count()}")
    yield _renderer(settings)
    yield _model(settings)
    yield _memory(settings)
    yield _port("HTTP port", settings.http_host, settings.http_port, "UNBEND_HTTP_PORT")
    yield _port("gRPC port", settings.grpc_host, settings.grpc_port, "UNBEND_GRPC_PORT")
    for extra, module in _EXTRAS.items():
        if find_spec(module):
            yield Finding(f"extra {extra}", "ok", "installed")
        else:
            yield Finding(f"extra {extra}", "note", "not installed", f"pip install 'unbend[{extra}]'")


def _renderer(settings: Settings) -> Finding:
    hardware, device = _in_child(_probe_egl)
    if hardware:
        return Finding("renderer", "ok", f"egl on {device}")
    needed = settings.renderer == "egl" or settings.require_gpu
    if hardware is None:
        return Finding("renderer", "bad" if needed else "note", f"no EGL: {device}", _EGL_REMEDY)
    if settings.require_gpu:
        return Finding("renderer", "bad", f"EGL is software only: {device}", "unset UNBEND_REQUIRE_GPU, or add a GPU")
    return Finding(
        "renderer", "ok", f"EGL is software only ({device}); {'egl' if settings.renderer == 'egl' else 'cpu'} is used"
    )


def _probe_egl() -> tuple[bool | None, str]:
    try:
        renderer = EglRenderer()
    except UnbendError as error:
        return None, str(error)
    info = renderer.info
    renderer.close()
    return info.hardware, info.device


def _in_child(probe: Callable[[], tuple[bool | None, str]]) -> tuple[bool | None, str]:
    """Runs ``probe`` in a process of its own: a broken driver may take the process down with it."""
    with get_context("spawn").Pool(1) as pool:
        return pool.apply_async(probe).get(timeout=60)


def _model(settings: Settings) -> Finding:
    try:
        info = load_estimator(settings.model, 1).model
    except UnbendError as error:
        return Finding("model", "bad", str(error), "set UNBEND_MODEL to a shipped model or to a readable file")
    return Finding("model", "ok", f"{info.name}, sha256 {info.sha256[:16]}…")


def _memory(settings: Settings) -> Finding:
    """Frames under way live in memfds, which count as memory and not against the size of /dev/shm."""
    available_mib = _available_mib()
    wanted_mib = settings.shared_memory_bytes >> 20
    detail = f"{available_mib} MiB available, at most {wanted_mib} MiB wanted for frames under way"
    if available_mib >= wanted_mib:
        return Finding("memory", "ok", detail)
    return Finding("memory", "note", detail, "lower UNBEND_SHARED_MEMORY_BYTES")


def _available_mib() -> int:
    with open("/proc/meminfo") as table:
        return next(int(line.split()[1]) >> 10 for line in table if line.startswith("MemAvailable"))


def _port(name: str, host: str, port: int, setting: str) -> Finding:
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            return Finding(name, "note", f"{host}:{port}: {error.strerror}", f"stop what uses it, or set {setting}")
    return Finding(name, "ok", f"{host}:{port} is free")


def _print(findings: list[Finding]) -> None:
    marks = {"ok": "[green]ok[/]", "note": "[yellow]note[/]", "bad": "[red]bad[/]"}
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column()
    table.add_column()
    table.add_column(overflow="fold")
    for finding in findings:
        remedy = f"\n→ {finding.remedy}" if finding.remedy else ""
        table.add_row(marks[finding.status], finding.name, finding.detail + remedy)
    console.print(table)
