"""Writes requirements.lock: what the service needs with all of its dependencies, each with the hashes of its wheels.

``python deploy/lock.py`` asks pip, with the versions of constraints.txt, what it would install from wheels alone on
each platform and Python that is served, and keeps names, versions and SHA-256; where a wheel comes from is left to the
index of whoever installs. ``pip install --require-hashes -r requirements.lock`` takes nothing else.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
import tomllib
from collections import defaultdict
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
LOCK = ROOT / "requirements.lock"
EXTRAS = ("service", "redis", "video", "export")
MACHINES = ("x86_64",)  # glcontext has no wheel for aarch64: there it is built, and has no hash to be known by
PYTHONS = ("3.11", "3.13")
#: Newest first: pip takes what it is told, and no older tag by itself.
GLIBCS = ("manylinux_2_34", "manylinux_2_28", "manylinux_2_27", "manylinux_2_24", "manylinux_2_17", "manylinux2014")

_HEAD = """# Written by `make lock`; `pip install --require-hashes -r requirements.lock` takes these wheels, no others.
# For Linux (glibc) on x86_64, Python 3.11 and 3.13.
"""


def wanted() -> list[str]:
    """The requirements of the distribution and its extras."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras: dict[str, list[str]] = project["optional-dependencies"]
    return [*project["dependencies"], *(one for extra in EXTRAS if extra in extras for one in extras[extra])]


def resolve(machine: str, python: str) -> list[dict[str, Any]]:
    """pip's report of what it would install. Raises CalledProcessError."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder, "report.json")
        platforms = [f"--platform={glibc}_{machine}" for glibc in GLIBCS]
        command = [sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", "--ignore-installed"]
        command += ["--disable-pip-version-check", "--only-binary=:all:", f"--python-version={python}", *platforms]
        command += [f"--target={folder}/nowhere", f"--report={report}", f"--constraint={ROOT / 'constraints.txt'}"]
        subprocess.run([*command, *wanted()], check=True)
        found: list[dict[str, Any]] = json.loads(report.read_text())["install"]
        return found


def main() -> int:
    hashes: dict[tuple[str, str], set[str]] = defaultdict(set)
    for machine in MACHINES:
        for python in PYTHONS:
            for package in resolve(machine, python):
                name = re.sub(r"[-_.]+", "-", package["metadata"]["name"]).lower()
                digest = package["download_info"]["archive_info"]["hashes"]["sha256"]
                hashes[name, package["metadata"]["version"]].add(digest)
    names = [name for name, _ in hashes]
    if len(set(names)) != len(names):
        sys.exit(f"two versions of one package: {sorted(name for name in set(names) if names.count(name) > 1)}")
    lines = [_HEAD]
    for (name, version), digests in sorted(hashes.items()):
        lines.append(f"{name}=={version}" + "".join(f" \\\n    --hash=sha256:{digest}" for digest in sorted(digests)))
    LOCK.write_text("\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
