"""Prints what the distribution and the extras named on the command line depend on, one requirement a line.

The image installs these before the code, so that a change of the code does not install them again.
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path


def requirements(project: dict[str, object], extras: list[str]) -> list[str]:
    """The dependencies of a ``[project]`` table and of ``extras``, sorted.

    Raises:
        KeyError: there is no such extra.
    """
    found: list[str] = list(project["dependencies"])  # type: ignore[call-overload] # a table of TOML
    optional: dict[str, list[str]] = project["optional-dependencies"]  # type: ignore[assignment] # as above
    for extra in extras:
        found += optional[extra]
    return sorted(found)


if __name__ == "__main__":
    text = (Path(__file__).parent.parent.parent / "pyproject.toml").read_text()
    print("\n".join(requirements(tomllib.loads(text)["project"], sys.argv[1:])))
