from __future__ import annotations

import os
from pathlib import Path

import pytest

from unbend_service.adapters.cores import usable_cores


@pytest.fixture(autouse=True)
def eight_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))


def write(root: Path, **files: str) -> None:
    for name, text in files.items():
        path = root / name.replace("__", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def test_without_a_quota_the_affinity_mask_counts(tmp_path: Path) -> None:
    """A machine without control groups gives all the cores that the scheduler does."""
    assert usable_cores(tmp_path) == 8
    write(tmp_path, proc__self__cgroup="0::/app\n")
    (tmp_path / "sys/fs/cgroup/app").mkdir(parents=True)
    (tmp_path / "sys/fs/cgroup/app/cpu.max").write_text("max 100000\n")
    assert usable_cores(tmp_path) == 8


@pytest.mark.parametrize(("limit", "cores"), [("250000 100000", 3), ("50000 100000", 1), ("1600000 100000", 8)])
def test_the_quota_of_a_container_counts(tmp_path: Path, limit: str, cores: int) -> None:
    """A quota of two and a half cores gives three workers something to do, and never fewer than one."""
    write(tmp_path, proc__self__cgroup="0::/\n")
    (tmp_path / "sys/fs/cgroup").mkdir(parents=True)
    (tmp_path / "sys/fs/cgroup/cpu.max").write_text(limit)
    assert usable_cores(tmp_path) == cores


def test_the_quota_of_a_group_above_counts(tmp_path: Path) -> None:
    """The tightest limit on the way up is the one that bites."""
    write(tmp_path, proc__self__cgroup="0::/pod/app\n")
    (tmp_path / "sys/fs/cgroup/pod/app").mkdir(parents=True)
    (tmp_path / "sys/fs/cgroup/pod/app/cpu.max").write_text("600000 100000")
    (tmp_path / "sys/fs/cgroup/pod/cpu.max").write_text("200000 100000")
    assert usable_cores(tmp_path) == 2


def test_control_groups_of_the_first_version_count(tmp_path: Path) -> None:
    """Older hosts say it in two files."""
    write(tmp_path, proc__self__cgroup="4:memory:/app\n3:cpuacct,cpu:/app\n0::/\n")
    group = tmp_path / "sys/fs/cgroup/cpu/app"
    group.mkdir(parents=True)
    (group / "cpu.cfs_quota_us").write_text("400000\n")
    (group / "cpu.cfs_period_us").write_text("100000\n")
    assert usable_cores(tmp_path) == 4
