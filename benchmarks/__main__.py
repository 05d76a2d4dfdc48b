"""``python -m benchmarks SUITE``."""

from __future__ import annotations

import argparse
import sys

from benchmarks import parity


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    suites = parser.add_subparsers(dest="suite", required=True)
    parity.add_arguments(suites.add_parser("parity", help=parity.__doc__))
    arguments = parser.parse_args()
    return parity.run(arguments)


if __name__ == "__main__":
    sys.exit(main())
