"""What once went wrong stays mended, and a minute of new attempts finds nothing."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.acceptance.conftest import Server, start_server, stop_server
from tests.fuzz.campaign import prepare, run
from tests.fuzz.cases import CORPUS, read
from tests.fuzz.sending import Senders


@pytest.fixture(scope="module")
def attacked() -> Iterator[Server]:
    running = start_server(workers="2", decoders="2", source_pixels="4000000")
    yield running
    assert stop_server(running) == 0


@pytest.mark.parametrize("path", sorted(CORPUS.glob("*.json")), ids=lambda path: path.stem)
async def test_what_was_found_stays_mended(attacked: Server, path: Path) -> None:
    """Each input that was once answered as a failure of the service is refused, and the service lives."""
    await prepare(attacked)
    senders = Senders(attacked.http, attacked.grpc)
    assert await senders.send(read(path)) is None
    await senders.close()
    assert attacked.get("/livez")


async def test_malformed_input_is_never_a_failure_of_the_service(attacked: Server) -> None:
    """Pictures, forms, grids, maps, queries, heads, messages and streams, each a little wrong."""
    verdict = await run(attacked, int(os.environ.get("FUZZ_N", "1500")), seed=20_26, found=None)
    assert verdict.passed, [wrong for wrong, _ in verdict.failures] or verdict.line()
