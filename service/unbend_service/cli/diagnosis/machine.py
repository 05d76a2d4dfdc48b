"""Cores, memory, ports and the place where grids are kept."""

from __future__ import annotations

import asyncio
import errno
import mmap
import os
import shutil
import socket
import sqlite3
from collections.abc import Callable
from pathlib import Path
from urllib.error import URLError
from urllib.request import urlopen

import grpc
from grpc_health.v1 import health_pb2, health_pb2_grpc

from unbend_service.adapters.cores import usable_cores
from unbend_service.adapters.grid_stores.redis import RedisGridStore
from unbend_service.adapters.metrics.prometheus import PrometheusMeter
from unbend_service.cli.diagnosis.finding import Finding
from unbend_service.domain.errors import UnbendError
from unbend_service.settings import Settings

_ASK_TIMEOUT_S = 2.0
_UNLIMITED = 1 << 60


def examine_cores() -> Finding:
    """How many cores may be used, and what keeps the others away."""
    usable, present = usable_cores(), os.cpu_count() or 1
    by_mask = len(os.sched_getaffinity(0))
    limit = "" if usable == present else " (by the CPU quota)" if usable < by_mask else " (by the affinity mask)"
    return Finding("cores", "ok", f"{usable} usable of {present}{limit}")


def examine_memory(settings: Settings, root: Path = Path("/")) -> Finding:
    """Frames under way live in memfds, which count as memory and not against the size of /dev/shm.

    Args:
        root: where ``proc`` and ``sys`` are looked for.
    """
    try:
        _map_anonymous_file()
    except OSError as error:
        remedy = "allow memfd_create and mmap in the seccomp profile of the container"
        return Finding("memory", "bad", f"no shared memory for frames: {error.strerror}", remedy)
    available_mib = available_bytes(root) >> 20
    wanted_mib = settings.shared_memory_bytes >> 20
    shm = root / "dev/shm"
    shm_text = (
        f"; /dev/shm has {shutil.disk_usage(shm).total >> 20} MiB, which frames do not need" if shm.is_dir() else ""
    )
    detail = f"{available_mib} MiB available, at most {wanted_mib} MiB wanted for frames under way{shm_text}"
    if available_mib >= wanted_mib:
        return Finding("memory", "ok", detail)
    return Finding("memory", "note", detail, "lower UNBEND_SHARED_MEMORY_BYTES, or give the container more memory")


def available_bytes(root: Path = Path("/")) -> int:
    """Memory that can still be had: of the machine, or less by the limit of the control group (v2)."""
    with open(root / "proc/meminfo") as table:
        free = next(int(line.split()[1]) << 10 for line in table if line.startswith("MemAvailable"))
    group = root / "sys/fs/cgroup"
    limit, used = _number(group / "memory.max"), _number(group / "memory.current")
    return min(free, max(0, limit - used)) if limit < _UNLIMITED and used < _UNLIMITED else free


def examine_http_port(settings: Settings) -> Finding:
    """Whether HTTP can listen, or does already."""
    return _port("HTTP port", "UNBEND_HTTP", settings.http_host, settings.http_port, _answers_http)


def examine_grpc_port(settings: Settings) -> Finding:
    """Whether gRPC can listen, or does already."""
    return _port("gRPC port", "UNBEND_GRPC", settings.grpc_host, settings.grpc_port, _answers_grpc)


def examine_grid_store(settings: Settings) -> Finding:
    """Whether grids can be kept where the settings say."""
    if settings.grid_store == "memory":
        return Finding("grid store", "ok", "memory: grids and stream ids are forgotten when the service ends")
    if settings.grid_store == "redis":
        return _examine_redis(settings)
    path = settings.grid_store_path.absolute()
    remedy = "set UNBEND_GRID_STORE_PATH to a file in a folder that this user may write to"
    if path.is_dir():
        return Finding("grid store", "bad", f"{path} is a folder", remedy)
    if not path.parent.is_dir():
        return Finding("grid store", "bad", f"there is no folder {path.parent}", remedy)
    if not os.access(path.parent, os.W_OK | os.X_OK):  # sqlite writes its journal beside the file
        return Finding("grid store", "bad", f"{path.parent} cannot be written to", remedy)
    if not path.exists():
        return Finding("grid store", "ok", f"sqlite: {path} will be made")
    if not os.access(path, os.R_OK | os.W_OK):
        return Finding("grid store", "bad", f"{path} cannot be written to", remedy)
    try:
        connection = sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True, timeout=_ASK_TIMEOUT_S)
        try:
            (verdict,) = connection.execute("PRAGMA quick_check(1)").fetchone()
        finally:
            connection.close()
    except sqlite3.Error as error:
        verdict = str(error)
    if verdict != "ok":
        return Finding("grid store", "bad", f"{path}: {verdict}", "move the file away: a new one will be made")
    return Finding("grid store", "ok", f"sqlite: {path}, {path.stat().st_size >> 10} KiB")


def _examine_redis(settings: Settings) -> Finding:
    async def ask() -> None:
        store = RedisGridStore(settings, PrometheusMeter())
        try:
            await store.ping()
        finally:
            await store.close()

    try:
        asyncio.run(ask())
    except UnbendError as error:
        remedy = "see UNBEND_REDIS_URL; until it answers, replicas share no grids"
        return Finding("grid store", "bad", f"redis: {error.message}", remedy)
    return Finding("grid store", "ok", f"redis answers; keys begin with {{{settings.redis_prefix}}}")


def _port(name: str, setting: str, host: str, port: int, answers: Callable[[str], bool]) -> Finding:
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            failure = error
        else:
            return Finding(name, "ok", f"{host}:{port} is free" if port else f"{host}: a free one will be taken")
    if failure.errno == errno.EADDRINUSE:
        reachable = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
        address = f"[{reachable}]:{port}" if ":" in reachable else f"{reachable}:{port}"
        if answers(address):
            return Finding(name, "ok", f"{host}:{port}: Unbend is running there")
        return Finding(name, "bad", f"{host}:{port} is taken", f"stop what uses it, or set {setting}_PORT")
    if failure.errno == errno.EACCES:
        return Finding(name, "bad", f"{host}:{port} is reserved", f"set {setting}_PORT to 1024 or more")
    return Finding(
        name, "bad", f"{host}:{port}: {failure.strerror}", f"set {setting}_HOST to an address of this machine"
    )


def _answers_http(address: str) -> bool:
    try:
        with urlopen(f"http://{address}/metrics", timeout=_ASK_TIMEOUT_S) as answer:
            return b"unbend_" in answer.read()
    except (URLError, OSError, ValueError):
        return False


def _answers_grpc(address: str) -> bool:
    request = health_pb2.HealthCheckRequest(service="unbend.v1.CorrectionService")
    with grpc.insecure_channel(address) as channel:
        try:
            health_pb2_grpc.HealthStub(channel).Check(request, timeout=_ASK_TIMEOUT_S)
        except grpc.RpcError:
            return False
    return True


def _map_anonymous_file() -> None:
    descriptor = os.memfd_create("unbend-doctor")
    try:
        os.ftruncate(descriptor, mmap.PAGESIZE)
        mmap.mmap(descriptor, mmap.PAGESIZE).close()
    finally:
        os.close(descriptor)


def _number(path: Path) -> int:
    """What a file of the control group says; unlimited if it says so or is not there."""
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return _UNLIMITED
