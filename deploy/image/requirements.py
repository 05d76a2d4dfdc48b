"""Prints the part of requirements.lock that the extras named on the command line need, hashes and all.

``--built`` prints of these what has no wheel for aarch64. The image installs them before the code, so that a change of
the code does not install them again.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable
from pathlib import Path

LOCK = Path(__file__).parent.parent.parent / "requirements.lock"
#: A package, its hashes, and the extras that need it, as deploy/lock.py writes them.
_ENTRY = re.compile(r"^([a-z0-9-]+)==(?:.|\n)+?\n    # for (.+)$", re.MULTILINE)
_BUILT = ("glcontext", "moderngl")


def requirements(lock: str, extras: Iterable[str], only: Iterable[str] = ()) -> str:
    """The entries of the lock that ``extras`` need, or of those only the packages named ``only``.

    Raises:
        KeyError: the lock knows no such extra.
    """
    entries = [(match[1], set(match[2].split()), match[0]) for match in _ENTRY.finditer(lock)]
    if unknown := set(extras).difference(*(known for _, known, _ in entries)):
        raise KeyError(f"{', '.join(sorted(unknown))}: not in {LOCK.name}")
    needed = {"core", *extras}
    return "\n".join(text for name, known, text in entries if known & needed and (not only or name in only))


if __name__ == "__main__":
    named = [argument for argument in sys.argv[1:] if argument != "--built"]
    print(requirements(LOCK.read_text(), named, _BUILT if "--built" in sys.argv else ()))
