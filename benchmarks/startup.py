"""Seconds from the start of a process until the service is ready, and until the client is imported."""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from dataclasses import asdict

from benchmarks.measurement import Report, Timing
from benchmarks.serving import served

BAR_READY_S = 3.0
BAR_IMPORT_S = 0.25


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the suite."""
    parser.add_argument("--runs", type=int, default=7, help="starts of each")


def run(arguments: argparse.Namespace) -> Report:
    """The service with all its workers' first, and ``import unbend`` beside an interpreter that does nothing and one
    that imports only what the client is made of."""
    report = Report("startup")
    runs = 2 if arguments.quick else arguments.runs
    ready: list[float] = []
    for _ in range(runs):
        with served() as service:
            ready.append(service.ready_s)
    commands = {"import unbend": "import unbend", "import numpy, grpc": "import numpy, grpc", "interpreter": "pass"}
    imports: dict[str, list[float]] = {name: [] for name in commands}
    for _ in range(runs + 1):
        for name, command in commands.items():
            start = time.perf_counter()
            subprocess.run([sys.executable, "-c", command], check=True)
            imports[name].append(time.perf_counter() - start)
    report.rows.append({"name": "service ready", "ours": asdict(Timing.of(ready))})
    for name, seconds in imports.items():
        report.rows.append({"name": f"process: {name}", "ours": asdict(Timing.of(seconds[1:]))})
        print(f"process: {name}: {Timing.of(seconds[1:])}", flush=True)
    report.add_ratio("service ready, s", Timing.of(ready).median_s, at_most=BAR_READY_S)
    client = Timing.of(imports["import unbend"][1:]).median_s - Timing.of(imports["interpreter"][1:]).median_s
    report.add_ratio("import unbend beyond the bare interpreter, s", client, at_most=BAR_IMPORT_S)
    return report
