from __future__ import annotations

from pathlib import Path

import pytest

from unbend_service.adapters.memory import check_shared_memory, memory_limit_bytes
from unbend_service.domain.errors import RendererUnavailable


def test_the_tightest_limit_of_the_control_groups_counts(tmp_path: Path) -> None:
    """The limit of a pod bites as well as that of its container."""
    (tmp_path / "proc/self").mkdir(parents=True)
    (tmp_path / "proc/self/cgroup").write_text("0::/pod/app\n")
    (tmp_path / "sys/fs/cgroup/pod/app").mkdir(parents=True)
    assert memory_limit_bytes(tmp_path) > 64 << 20
    (tmp_path / "sys/fs/cgroup/pod/app/memory.max").write_text("max\n")
    (tmp_path / "sys/fs/cgroup/pod/memory.max").write_text(f"{64 << 20}\n")
    assert memory_limit_bytes(tmp_path) == 64 << 20


def test_control_groups_of_the_first_version_count(tmp_path: Path) -> None:
    """Older hosts say it elsewhere."""
    (tmp_path / "proc/self").mkdir(parents=True)
    (tmp_path / "proc/self/cgroup").write_text("4:memory:/app\n0::/\n")
    (tmp_path / "sys/fs/cgroup/memory/app").mkdir(parents=True)
    (tmp_path / "sys/fs/cgroup/memory/app/memory.limit_in_bytes").write_text(f"{32 << 20}\n")
    assert memory_limit_bytes(tmp_path) == 32 << 20


def test_memory_for_frames_must_leave_room_for_the_rest() -> None:
    """A quarter of the limit is for everything else; the refusal says what would be allowed."""
    check_shared_memory(768 << 20, 1 << 30)
    with pytest.raises(RendererUnavailable, match="1024 MiB") as refusal:
        check_shared_memory((768 << 20) + 1, 1 << 30)
    assert refusal.value.setting == "shared_memory_bytes"
