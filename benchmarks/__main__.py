"""``python -m benchmarks SUITE``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from benchmarks import (
    estimate,
    http_load,
    memory,
    parity,
    render,
    replicas,
    scale,
    scale_demo,
    startup,
    stream,
    summary,
    video,
)

SUITES = {
    "render": render,
    "estimate": estimate,
    "http": http_load,
    "startup": startup,
    "stream": stream,
    "scale": scale,
    "replicas": replicas,
    "memory": memory,
    "video": video,
}


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    suites = parser.add_subparsers(dest="suite", required=True)
    parity.add_arguments(suites.add_parser("parity", help=parity.__doc__))
    summary.add_arguments(suites.add_parser("summary", help=summary.__doc__))
    scale_demo.add_arguments(suites.add_parser("scale-demo", help=scale_demo.__doc__))
    for name, suite in SUITES.items():
        options = suites.add_parser(name, help=suite.__doc__)
        options.add_argument("--json", type=Path, help="file for the results")
        options.add_argument("--quick", action="store_true", help="few turns: shows that it runs, measures nothing")
        suite.add_arguments(options)
    arguments = parser.parse_args()
    if arguments.suite == "parity":
        return parity.run(arguments)
    if arguments.suite == "summary":
        return summary.run(arguments)
    if arguments.suite == "scale-demo":
        return scale_demo.run(arguments)
    report = SUITES[arguments.suite].run(arguments)
    if arguments.json is not None:
        report.write(arguments.json)
    return 0 if report.ok or arguments.quick else 1


if __name__ == "__main__":
    sys.exit(main())
