"""The ``unbend`` command; everything behind it needs the ``service`` extra."""

from __future__ import annotations

import importlib
import sys


def main() -> None:
    """Runs the command line of the service package, or says which extra is missing."""
    try:
        command_line = importlib.import_module("unbend_service.cli")
    except ImportError as error:
        sys.exit(
            f"unbend: the command line needs the service extra ({error.name} is missing): pip install 'unbend[service]'"
        )
    command_line.main()


if __name__ == "__main__":
    main()
