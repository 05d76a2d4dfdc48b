"""Malformed input of every kind against a real service: ``FUZZ_N=100000 FUZZ_SEED=1 python -m tests.fuzz``.

The last line is the verdict, and the exit status follows it. What went wrong is written to artifacts/fuzz, from where
it goes to tests/fuzz/corpus once it is understood.
"""

from __future__ import annotations

import asyncio
import os
import sys
from pathlib import Path

from tests.acceptance.conftest import start_server, stop_server
from tests.fuzz.campaign import run


def main() -> int:
    count, seed = int(os.environ.get("FUZZ_N", "100000")), int(os.environ.get("FUZZ_SEED", "1"))
    server = start_server(workers="2", decoders="2", source_pixels="4000000")
    try:
        verdict = asyncio.run(run(server, count, seed, Path("artifacts/fuzz")))
        status = stop_server(server)
        if status != 0:
            verdict.deaths = 1
    finally:
        server.process.kill()
    print(verdict.line())
    return 0 if verdict.passed else 1


if __name__ == "__main__":
    sys.exit(main())
