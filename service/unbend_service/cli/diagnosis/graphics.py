"""EGL: its vendor files, its devices, and the context that the renderer would get."""

from __future__ import annotations

import ctypes
import json
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path
from types import TracebackType
from typing import TypeVar

from unbend_service.cli.diagnosis.egl_devices import EglDevice, list_devices
from unbend_service.cli.diagnosis.finding import Finding
from unbend_service.domain.errors import UnbendError
from unbend_service.settings import Settings

T = TypeVar("T")

_TIMEOUT_S = 60
_INSTALL = "install libegl1 and a driver: libgl1-mesa-dri (Debian) draws in software"
_NVIDIA = (
    "an NVIDIA card is here and its EGL driver is not: run the container with --gpus all and "
    "NVIDIA_DRIVER_CAPABILITIES=graphics,compute,utility; see docs/egl.md"
)
_NODES = (
    "let this user open the render nodes: docker run --device /dev/dri --group-add $(stat -c %g /dev/dri/renderD128)"
)
_CPU_WORKS = "the cpu renderer works without"
#: Where glvnd looks for vendor files unless it is told otherwise.
_VENDOR_FOLDERS = ("/etc/glvnd/egl_vendor.d", "/usr/share/glvnd/egl_vendor.d")


def examine_graphics(settings: Settings, root: Path = Path("/")) -> Iterator[Finding]:
    """Vendor files, devices, renderer.

    Args:
        root: where ``dev``, ``etc`` and ``usr`` are looked for.
    """
    needed = settings.renderer == "egl" or settings.require_gpu
    with Sandbox() as sandbox:
        yield _vendors(sandbox, root)
        yield _devices(settings, needed, sandbox, root)
        yield _renderer(settings, needed, sandbox, root)


def _vendors(sandbox: Sandbox, root: Path) -> Finding:
    """Which drivers glvnd would try, and whether their libraries load."""
    files = _vendor_files(root)
    if not files:
        remedy = _NVIDIA if _has_nvidia(root) else f"{_INSTALL}; {_CPU_WORKS}"
        return Finding("EGL vendors", "note", "no vendor file: libEGL has no driver to choose", remedy)
    parts, broken = [], []
    for file in files:
        try:
            library = str(json.loads(file.read_text())["ICD"]["library_path"])
            sandbox.ask(_load, library)
        except (OSError, ValueError, KeyError, TypeError) as error:
            broken.append(file.name)
            parts.append(f"{file.name} ({error})")
        else:
            parts.append(f"{file.name} ({library})")
    if broken:
        remedy = f"install the driver that {', '.join(broken)} names, or remove the file"
        return Finding("EGL vendors", "note", ", ".join(parts), remedy)
    if _has_nvidia(root) and not any("nvidia" in part.lower() for part in parts):
        return Finding("EGL vendors", "note", ", ".join(parts), _NVIDIA)
    return Finding("EGL vendors", "ok", ", ".join(parts))


def _vendor_files(root: Path) -> list[Path]:
    if named := os.environ.get("__EGL_VENDOR_LIBRARY_FILENAMES"):
        return [Path(name) for name in named.split(":") if name]
    if folders := os.environ.get("__EGL_VENDOR_LIBRARY_DIRS"):
        return [file for folder in folders.split(":") for file in sorted(Path(folder).glob("*.json"))]
    return [file for folder in _VENDOR_FOLDERS for file in sorted((root / folder.lstrip("/")).glob("*.json"))]


def _devices(settings: Settings, needed: bool, sandbox: Sandbox, root: Path) -> Finding:
    bad = "bad" if needed else "note"
    try:
        devices = sandbox.ask(list_devices)
    except OSError as error:
        return Finding("EGL devices", bad, str(error), _remedy(needed, root))
    if not devices:
        return Finding("EGL devices", bad, "libEGL lists none", _remedy(needed, root))
    detail = "; ".join(_describe(device) for device in devices)
    if settings.egl_device >= len(devices):
        choice = "0" if len(devices) == 1 else f"0..{len(devices) - 1}"
        wrong = f"there is no device {settings.egl_device}: {detail}"
        return Finding("EGL devices", bad, wrong, f"set UNBEND_EGL_DEVICE to {choice}")
    if locked := _locked_nodes(root):
        return Finding("EGL devices", "note", f"{detail}; no access to {', '.join(locked)}", _NODES)
    return Finding("EGL devices", "ok", detail)


def _describe(device: EglDevice) -> str:
    traits = [device.driver or "does not start", device.node, "software" if device.software else ""]
    return f"{device.index}: {', '.join(trait for trait in traits if trait)}"


def _renderer(settings: Settings, needed: bool, sandbox: Sandbox, root: Path) -> Finding:
    if settings.renderer == "cpu":
        if settings.require_gpu:
            return Finding(
                "renderer", "bad", "a GPU is required, and the cpu renderer was chosen", "unset UNBEND_RENDERER"
            )
        return Finding("renderer", "ok", "cpu, as set")
    try:
        hardware, device = sandbox.ask(_open_egl, settings.egl_device)
    except OSError as error:
        return Finding("renderer", "bad" if needed else "note", f"no EGL context: {error}", _remedy(needed, root))
    if hardware:
        return Finding("renderer", "ok", f"egl on {device}")
    if settings.require_gpu:
        remedy = _NVIDIA if _has_nvidia(root) else "unset UNBEND_REQUIRE_GPU, or add a GPU"
        return Finding("renderer", "bad", f"EGL is software only: {device}", remedy)
    used = "egl" if settings.renderer == "egl" else "cpu"
    return Finding("renderer", "ok", f"{used}; EGL is software only ({device})")


def _open_egl(device: int) -> tuple[bool, str]:
    """Whether the context is on hardware, and the driver's name for it. Raises OSError."""
    from unbend_service.adapters.renderers.egl import EglRenderer  # here, so that only the child loads OpenGL

    try:
        renderer = EglRenderer(device)
    except UnbendError as error:
        raise OSError(error.message) from error
    info = renderer.info
    renderer.close()
    return info.hardware, info.device


def _remedy(needed: bool, root: Path) -> str:
    """What helps where EGL gives nothing."""
    if _has_nvidia(root):
        return _NVIDIA
    return f"mend what the lines above name, or {_INSTALL}" if needed else f"{_INSTALL}; {_CPU_WORKS}"


def _load(library: str) -> None:
    ctypes.CDLL(library)


class Sandbox:
    """A process of its own for questions to drivers, which may take down the process that asks; replaced when lost."""

    def __init__(self) -> None:
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Sandbox:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end()

    def ask(self, probe: Callable[..., T], *arguments: object, timeout_s: float = _TIMEOUT_S) -> T:
        """The answer of ``probe``, a function of a module. Raises OSError if it does, dies, or takes too long."""
        if self._pool is None:
            self._pool = ProcessPoolExecutor(1, mp_context=get_context("spawn"))
        try:
            return self._pool.submit(probe, *arguments).result(timeout_s)
        except BrokenProcessPool as error:
            self._end()
            raise OSError("the driver crashed the process that asked it") from error
        except TimeoutError as error:
            for process in list((self._pool._processes or {}).values()):
                process.kill()  # a driver that hangs would be waited for at the end
            self._end()
            raise OSError(f"the driver did not answer within {timeout_s:g} s") from error

    def _end(self) -> None:
        pool, self._pool = self._pool, None
        if pool is not None:
            pool.shutdown()


def _has_nvidia(root: Path) -> bool:
    return any((root / path).exists() for path in ("dev/nvidiactl", "proc/driver/nvidia/version"))


def _locked_nodes(root: Path) -> list[str]:
    nodes = sorted((root / "dev/dri").glob("renderD*"))
    return [f"/dev/dri/{node.name}" for node in nodes if not os.access(node, os.R_OK | os.W_OK)]
