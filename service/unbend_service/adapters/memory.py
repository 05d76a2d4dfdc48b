"""How much memory this process and its workers may use."""

from __future__ import annotations

import os
from pathlib import Path

from unbend_service.adapters.control_groups import control_groups, read
from unbend_service.domain.errors import RendererUnavailable

#: The rest is for pictures, models, maps and the programs themselves.
_SHARE_FOR_FRAMES = 0.75


def memory_limit_bytes(root: Path = Path("/")) -> int:
    """Memory of the machine, or less by the limit of a control group (v2 or v1) on the way up from ours.

    Args:
        root: where ``proc`` and ``sys`` are looked for.
    """
    names = ("memory.max", "memory.limit_in_bytes")
    limits = [read(directory / name) for directory in control_groups("memory", root) for name in names]
    machine_bytes = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return min([machine_bytes, *(int(limit) for limit in limits if limit.isdecimal())])


def check_shared_memory(wanted_bytes: int, limit_bytes: int) -> None:
    """Frames under way lie in memfds, which count as memory like any other: better refused now than killed later.

    Raises:
        RendererUnavailable: more is wanted than leaves room for anything else.
    """
    allowed_bytes = int(limit_bytes * _SHARE_FOR_FRAMES)
    if wanted_bytes > allowed_bytes:
        raise RendererUnavailable(
            f"Frames under way may take {wanted_bytes >> 20} MiB, and all of the service may use "
            f"{limit_bytes >> 20} MiB.",
            allowed=f"up to {allowed_bytes} bytes, or more memory for the container",
            setting="shared_memory_bytes",
        )
