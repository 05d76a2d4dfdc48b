"""What the processes of the service hold while there is nothing to do, time after time."""

from __future__ import annotations

import time
from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np
import psutil

from tests.endurance.verdict import Verdict
from tests.endurance.watching import Watched

BAR_MB_PER_HOUR = 1.0
#: A slope is a figure only after a while; before, memory may just not have grown by more than this.
LONG_RUN_S, SHORT_GROWTH_MB = 1800.0, 32.0
#: Of Python's blocks, about; they are at most 512 bytes long.
_BLOCK_BYTES = 100

Points = list[tuple[float, float]]


@dataclass
class Holdings:
    """Looks at memory at rest: under load it shows what was under way just then.

    Attributes:
        resident: MB of each process without what is shared (files, frames), by name; each with the time of the look.
        used: MB that the parent's malloc has handed out.
        blocks: MB of the blocks that the parent's Python has handed out.
    """

    watched: Watched
    names: dict[int, str] = field(default_factory=dict)
    resident: dict[str, Points] = field(default_factory=lambda: defaultdict(list))
    used: Points = field(default_factory=list)
    blocks: Points = field(default_factory=list)

    def __post_init__(self) -> None:
        self.names[self.watched.process.pid] = "parent"
        self.names |= {worker.pid: f"worker {n}" for n, worker in enumerate(self.watched.workers())}
        others = [child for child in self.watched.process.children() if child.pid not in self.names]
        self.names |= {child.pid: f"decoder {n}" for n, child in enumerate(others)}

    def look(self) -> None:
        now_s = time.monotonic()
        for pid, name in self.names.items():
            memory = psutil.Process(pid).memory_info()
            self.resident[name].append((now_s, (memory.rss - memory.shared) / 1e6))
        self.used.append((now_s, self.watched.metric("unbend_memory_bytes", state="used") / 1e6))
        self.blocks.append((now_s, self.watched.metric("unbend_python_blocks") * _BLOCK_BYTES / 1e6))
        held = ", ".join(f"{name} {points[-1][1]:.1f}" for name, points in self.resident.items())
        print(f"   at {now_s - self.used[0][0]:.0f} s: {held}; malloc {self.used[-1][1]:.1f} MB", flush=True)

    def judge(self, verdict: Verdict, seconds: float) -> None:
        """The slopes after the first third, which is warm-up.

        More is explained to the allocator where neither what malloc has handed out grows, nor what Python has.
        """
        if seconds < LONG_RUN_S:
            for name, points in sorted(self.resident.items()):
                growth = points[-1][1] - points[0][1]
                figure = f"{name}: {_range(points)}, {growth:+.1f} of {SHORT_GROWTH_MB:g}"
                verdict.say(figure, growth <= SHORT_GROWTH_MB)
            return
        parts = {"malloc": _slope(self.used)[0], "Python": _slope(self.blocks)[0]}
        explained = all(slope <= BAR_MB_PER_HOUR for slope in parts.values())
        for name, points in sorted(self.resident.items()):
            slope, error = _slope(points)
            kept = slope <= BAR_MB_PER_HOUR or (name == "parent" and explained)
            figure = f"{name}: {_range(points)}, {slope:+.2f} ± {error:.2f} MB/h (at most {BAR_MB_PER_HOUR:g})"
            verdict.say(figure, kept)
        in_use = ", ".join(f"{name} {slope:+.2f} MB/h" for name, slope in parts.items())
        verdict.say(f"of the parent in use: {in_use}")


def _range(points: Points) -> str:
    return f"{points[0][1]:.1f} to {points[-1][1]:.1f} MB at rest"


def _slope(points: Points) -> tuple[float, float]:
    """MB an hour after the first third, and its standard error."""
    kept = np.array(points[len(points) // 3 :])
    hours = (kept[:, 0] - kept[0, 0]) / 3600
    (slope, _), covariance = np.polyfit(hours, kept[:, 1], 1, cov=True)
    return float(slope), float(covariance[0, 0] ** 0.5)
