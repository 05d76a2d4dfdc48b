"""Where the limits of this process's control groups are written down."""

from __future__ import annotations

from pathlib import Path


def control_groups(controller: str, root: Path = Path("/")) -> list[Path]:
    """Directories of a controller (v2 or v1), from our own group up to the root of what we see.

    Args:
        controller: ``cpu`` or ``memory``.
        root: where ``proc`` and ``sys`` are looked for.
    """
    mount = root / "sys/fs/cgroup"
    directories = []
    for line in read(root / "proc/self/cgroup").splitlines():
        _, controllers, group = line.split(":", 2)
        if controllers == "":
            directories += _upwards(mount, group)
        elif controller in controllers.split(","):
            directories += _upwards(mount / controller, group)
    return directories


def read(path: Path) -> str:
    """What stands in a file; nothing if it cannot be read."""
    try:
        return path.read_text().strip()
    except OSError:
        return ""


def _upwards(mount: Path, group: str) -> list[Path]:
    own = mount / group.strip("/")
    return [own, *(parent for parent in own.parents if parent.is_relative_to(mount))]
