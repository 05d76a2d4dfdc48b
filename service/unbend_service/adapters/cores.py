"""How many cores this process may use."""

from __future__ import annotations

import math
import os
from pathlib import Path

from unbend_service.adapters.control_groups import control_groups, read


def usable_cores(root: Path = Path("/")) -> int:
    """Cores that the scheduler lets us use: the affinity mask, and the CPU quota of the control group (v2 or v1).

    Args:
        root: where ``proc`` and ``sys`` are looked for.
    """
    cores = len(os.sched_getaffinity(0))
    quota = min(_quotas(root), default=math.inf)
    return max(1, min(cores, math.ceil(quota) if math.isfinite(quota) else cores))


def _quotas(root: Path) -> list[float]:
    """Every CPU limit, in cores, on the way from our control group up to the root of what we see."""
    quotas = []
    for directory in control_groups("cpu", root):
        limit = read(directory / "cpu.max").split()
        if len(limit) == 2 and limit[0] != "max":
            quotas.append(int(limit[0]) / int(limit[1]))
        quota, period = read(directory / "cpu.cfs_quota_us"), read(directory / "cpu.cfs_period_us")
        if quota and period and int(quota) > 0:
            quotas.append(int(quota) / int(period))
    return quotas
