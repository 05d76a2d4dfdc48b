"""``python -m tests.endurance chaos|soak|overload --seconds N``.

The last line is the verdict with its figures, and the exit status follows it.
"""

from __future__ import annotations

import argparse
import sys

from tests.endurance import chaos, overload, soak

RUNS = {"chaos": chaos.run, "soak": soak.run, "overload": overload.run}


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.endurance", description=__doc__)
    parser.add_argument("run", choices=RUNS)
    parser.add_argument("--seconds", type=float, required=True, help="how long the load lasts")
    parser.add_argument("--renderer", choices=["cpu", "egl"], default="cpu")
    arguments = parser.parse_args()
    verdict = RUNS[arguments.run](arguments.seconds, arguments.renderer)
    print(verdict, flush=True)
    return 0 if verdict.passed else 1


if __name__ == "__main__":
    sys.exit(main())
