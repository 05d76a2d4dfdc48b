"""Timing by turns, and reports that say where and on what they were made."""

from __future__ import annotations

import json
import os
import platform
import statistics
import subprocess
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

_PACKAGES = ("numpy", "opencv-python-headless", "onnxruntime", "grpcio", "moderngl", "pillow")


@dataclass(frozen=True, slots=True)
class Timing:
    """Seconds of one thing that was done many times."""

    median_s: float
    iqr_s: float
    runs: int

    @classmethod
    def of(cls, seconds: list[float]) -> Timing:
        """From single durations, at least two."""
        low, _, high = statistics.quantiles(seconds, n=4)
        return cls(statistics.median(seconds), high - low, len(seconds))

    def __str__(self) -> str:
        return f"{self.median_s * 1e3:.2f} ms (IQR {self.iqr_s * 1e3:.2f}, n={self.runs})"


@dataclass(frozen=True, slots=True)
class Pair:
    """Ours and a peer, timed by turns in one run.

    Attributes:
        ratio: median of ours / peer over the turns, so that a machine that drifts does not matter.
    """

    ours: Timing
    peer: Timing
    ratio: float

    def per(self, parts: int) -> Pair:
        """The same for one of ``parts`` equal parts of what was timed."""
        first, second = (
            Timing(whole.median_s / parts, whole.iqr_s / parts, whole.runs) for whole in (self.ours, self.peer)
        )
        return Pair(first, second, self.ratio)


def by_turns(ours: Callable[[], object], peer: Callable[[], object], runs: int, warm_up: int = 3) -> Pair:
    """Times both alternately, after ``warm_up`` turns that do not count.

    A function that returns a float has measured its seconds itself.
    """
    timed: list[tuple[float, float]] = []
    for turn in range(warm_up + runs):
        order = (ours, peer) if turn % 2 else (peer, ours)
        spent: dict[Callable[[], object], float] = {}
        for function in order:
            start = time.perf_counter()
            own_s = function()
            spent[function] = own_s if isinstance(own_s, float) else time.perf_counter() - start
        if turn >= warm_up:
            timed.append((spent[ours], spent[peer]))
    return Pair(
        Timing.of([a for a, _ in timed]),
        Timing.of([b for _, b in timed]),
        statistics.median(a / b for a, b in timed),
    )


def machine() -> dict[str, Any]:
    """What it ran on."""
    model = next(
        (
            line.split(":", 1)[1].strip()
            for line in _read("/proc/cpuinfo").splitlines()
            if line.startswith("model name")
        ),
        platform.processor(),
    )
    memory_kib = next((line.split()[1] for line in _read("/proc/meminfo").splitlines() if "MemTotal" in line), "0")
    return {
        "processor": model,
        "cores": len(os.sched_getaffinity(0)),
        "memory_gib": round(int(memory_kib) / 2**20, 1),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "packages": {name: metadata.version(name) for name in _PACKAGES},
    }


def commit() -> str:
    """Short hash of the checkout, with ``+`` when it has uncommitted changes."""
    root = Path(__file__).parent
    head = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=root, capture_output=True, text=True, check=False
    )
    changed = subprocess.run(["git", "status", "--porcelain"], cwd=root, capture_output=True, text=True, check=False)
    return head.stdout.strip() + ("+" if changed.stdout.strip() else "")


@dataclass
class Report:
    """What a suite found.

    Attributes:
        rows: one dictionary a measurement, all with the same keys within a table.
        ratios: name -> {value, bar, ok}; ``ok`` is whether the bar was met.
    """

    suite: str
    rows: list[dict[str, Any]] = field(default_factory=list)
    ratios: dict[str, dict[str, Any]] = field(default_factory=dict)

    def add_ratio(
        self, name: str, value: float, *, at_most: float | None = None, at_least: float | None = None
    ) -> None:
        """Judges one ratio against its bar."""
        if (at_most is None) == (at_least is None):
            raise ValueError("a ratio has one bar")
        bar = at_most if at_most is not None else at_least
        ok = value <= at_most if at_most is not None else value >= (at_least or 0.0)
        self.ratios[name] = {
            "value": round(value, 3),
            "bar": f"{'<=' if at_most is not None else '>='} {bar}",
            "ok": ok,
        }
        print(f"{'ok    ' if ok else 'MISSED'} {name}: {value:.3f} (bar {self.ratios[name]['bar']})", flush=True)

    def add_pair(self, name: str, pair: Pair, **more: Any) -> None:
        """Keeps one comparison as a row."""
        self.rows.append(
            {"name": name, "ours": asdict(pair.ours), "peer": asdict(pair.peer), "ratio": pair.ratio, **more}
        )
        print(f"{name}: ours {pair.ours}, peer {pair.peer}, ratio {pair.ratio:.3f}", flush=True)

    @property
    def ok(self) -> bool:
        return all(ratio["ok"] for ratio in self.ratios.values())

    def write(self, path: Path) -> None:
        """One JSON file: when, where, which commit, rows and ratios."""
        content = {
            "suite": self.suite,
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
            "commit": commit(),
            "machine": machine(),
            "ratios": self.ratios,
            "rows": self.rows,
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(content, indent=1) + "\n")


def _read(path: str) -> str:
    try:
        return Path(path).read_text()
    except OSError:
        return ""
