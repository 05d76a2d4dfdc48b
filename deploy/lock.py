"""Writes requirements.lock and requirements-build.lock: what is installed, with the hashes of what pip may take.

``python deploy/lock.py`` asks pip, with the versions of constraints.txt, what it would install on each machine and
Python that is served, and keeps names, versions and SHA-256; where a file comes from is left to the index of whoever
installs. ``pip install --require-hashes -r requirements.lock`` takes nothing else. A comment after each package names
the extras that need it, so that an image can leave out what it does not serve (``deploy/image/requirements.py``).
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
LOCK, BUILD_LOCK = ROOT / "requirements.lock", ROOT / "requirements-build.lock"
EXTRAS = ("service", "redis", "video", "export", "lensfun", "otel")
MACHINES = ("x86_64", "aarch64")
PYTHONS = ("3.11", "3.13")
#: Have no wheel for aarch64: there they are built, from sources that are known by their hash.
BUILT = ("glcontext", "moderngl")
#: Wanted by Pythons before 3.11.3, such as Debian 12's; pip asks such conditions of the Python that it runs in.
ALSO = {"redis": ("async-timeout>=4.0.3",)}
#: Newest first: pip takes what it is told, and no older tag by itself.
GLIBCS = ("manylinux_2_34", "manylinux_2_28", "manylinux_2_27", "manylinux_2_24", "manylinux_2_17", "manylinux2014")
#: Builds the distribution, and what is BUILT.
BUILDERS = ("hatchling", "setuptools", "wheel")

_HEAD = """# Written by `make lock`; `pip install --require-hashes -r {name}` takes these files, no others.
# For Linux (glibc) on x86_64 and aarch64, Python 3.11 and 3.13.
"""


@dataclass
class Locked:
    """One package.

    Attributes:
        extras: that need it; ``core``: the client too.
    """

    version: str
    hashes: set[str] = field(default_factory=set)
    extras: set[str] = field(default_factory=set)


def wanted(extras: Iterable[str] = EXTRAS) -> list[str]:
    """The requirements of the distribution and of ``extras``. Raises KeyError: there is no such extra."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    optional: dict[str, list[str]] = project["optional-dependencies"]
    return [*project["dependencies"], *(one for extra in extras for one in (*optional[extra], *ALSO.get(extra, ())))]


def resolve(requirements: Sequence[str], python: str) -> list[tuple[str, str, str]]:
    """Name, version and hash of all that pip would install on x86_64. Raises CalledProcessError."""
    return _reported([*_for("x86_64", python), *requirements])


def files(pins: Sequence[str], machine: str, python: str) -> list[tuple[str, str, str]]:
    """As :func:`resolve`, of these very versions."""
    return _reported(["--no-deps", *_for(machine, python), *pins])


def sources(pins: Sequence[str]) -> list[tuple[str, str, str]]:
    """As :func:`files`, of what they are built from."""
    return _reported(["--no-deps", "--no-binary=:all:", *pins]) if pins else []


def main() -> int:
    LOCK.write_text(text(LOCK.name, lock({extra: wanted([extra]) for extra in EXTRAS} | {"core": wanted([])})))
    BUILD_LOCK.write_text(text(BUILD_LOCK.name, lock({"build": BUILDERS})))
    return 0


def lock(groups: Mapping[str, Sequence[str]]) -> dict[str, Locked]:
    """Every package that one of the groups of requirements needs."""
    packages: dict[str, Locked] = {}
    for python in PYTHONS:
        for group, requirements in groups.items():
            for name, version, digest in resolve(requirements, python):
                locked = packages.setdefault(name, Locked(version))
                if locked.version != version:
                    sys.exit(f"two versions of {name}: {locked.version} and {version}")
                locked.hashes.add(digest)
                locked.extras.add(group)
        for machine in MACHINES[1:]:
            pins = [f"{name}=={one.version}" for name, one in packages.items() if name not in BUILT]
            for name, _, digest in files(pins, machine, python):
                packages[name].hashes.add(digest)
    built = [f"{name}=={packages[name].version}" for name in BUILT if name in packages]
    for name, _, digest in sources(built):
        packages[name].hashes.add(digest)
    return packages


def text(name: str, packages: dict[str, Locked]) -> str:
    """The file."""
    lines = [_HEAD.format(name=name)]
    for package, locked in sorted(packages.items()):
        lines.append(
            f"{package}=={locked.version}"
            + "".join(f" \\\n    --hash=sha256:{digest}" for digest in sorted(locked.hashes))
            + f"\n    # for {' '.join(sorted(locked.extras))}"
        )
    return "\n".join(lines) + "\n"


def _for(machine: str, python: str) -> list[str]:
    platforms = [f"--platform={glibc}_{machine}" for glibc in GLIBCS]
    return ["--only-binary=:all:", f"--python-version={python}", *platforms]


def _reported(arguments: Sequence[str]) -> list[tuple[str, str, str]]:
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder, "report.json")
        command = [sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", "--ignore-installed"]
        command += ["--disable-pip-version-check", f"--target={folder}/nowhere", f"--report={report}"]
        subprocess.run([*command, f"--constraint={ROOT / 'constraints.txt'}", *arguments], check=True)
        return [_entry(package) for package in json.loads(report.read_text())["install"]]


def _entry(package: dict[str, Any]) -> tuple[str, str, str]:
    name = re.sub(r"[-_.]+", "-", package["metadata"]["name"]).lower()
    return name, package["metadata"]["version"], package["download_info"]["archive_info"]["hashes"]["sha256"]


if __name__ == "__main__":
    sys.exit(main())
