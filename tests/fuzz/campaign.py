"""Many cases against one service, and what came of them."""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import psutil

from tests.acceptance.conftest import Server
from tests.fuzz.cases import Case, HttpCase, write
from tests.fuzz.inputs import Inputs
from tests.fuzz.seeds import grids
from tests.fuzz.sending import Senders

_CONNECTIONS = 48
#: Memory that may come on top of what the first tenth of the inputs left behind.
_GROWTH_BYTES = 192 << 20
_LOOK_EVERY = 500


@dataclass
class Verdict:
    """Figures of a campaign; ``failures`` are what was wrong, with the case."""

    sent: Counter[str] = field(default_factory=Counter)
    failures: list[tuple[str, Case]] = field(default_factory=list)
    deaths: int = 0
    seconds: float = 0.0
    warm_bytes: int = 0
    most_bytes: int = 0
    decoders_replaced: float = 0.0

    @property
    def passed(self) -> bool:
        return not self.failures and not self.deaths and self.most_bytes <= self.warm_bytes + _GROWTH_BYTES

    def line(self) -> str:
        """One line for people and for `tail -1`."""
        return (
            f"fuzz {'PASSED' if self.passed else 'FAILED'}: {sum(self.sent.values())} malformed inputs "
            f"({self.sent['http']} HTTP, {self.sent['grpc']} gRPC) in {self.seconds:.0f} s, "
            f"{len(self.failures)} answered 5xx/INTERNAL/UNKNOWN or not at all, {self.deaths} deaths of the front, "
            f"{self.decoders_replaced:.0f} decoders replaced, RSS of the front {self.warm_bytes >> 20} MiB warm, "
            f"{self.most_bytes >> 20} MiB at most (allowed {(self.warm_bytes + _GROWTH_BYTES) >> 20})"
        )


async def run(server: Server, count: int, seed: int, found: Path | None) -> Verdict:
    """Sends ``count`` cases; writes those that went wrong to ``found``."""
    verdict = Verdict()
    cases = islice(iter(Inputs(seed)), count)
    process = psutil.Process(server.process.pid)
    started = time.monotonic()
    await prepare(server)

    async def work() -> None:
        senders = Senders(server.http, server.grpc)
        for case in cases:
            if server.process.poll() is not None:
                verdict.deaths = 1
                return
            try:
                wrong = await senders.send(case)
            except OSError as error:
                wrong = f"no connection: {error}"
            verdict.sent["http" if isinstance(case, HttpCase) else "grpc"] += 1
            if wrong is not None:
                verdict.failures.append((wrong, case))
                print(wrong[:300], write(case, found) if found else "", flush=True)
            look(sum(verdict.sent.values()))
        await senders.close()

    def look(done: int) -> None:
        if done % _LOOK_EVERY and done != count:
            return
        size_bytes = process.memory_info().rss
        if done <= max(_LOOK_EVERY, count // 10):
            verdict.warm_bytes = size_bytes
        verdict.most_bytes = max(verdict.most_bytes, size_bytes)
        del server.lines[:]
        if done % 5000 == 0:
            print(f"{done} sent, {size_bytes >> 20} MiB, {time.monotonic() - started:.0f} s", flush=True)

    await asyncio.gather(*(work() for _ in range(_CONNECTIONS)))
    verdict.seconds = time.monotonic() - started
    if server.process.poll() is not None:
        verdict.deaths = 1
    elif await asyncio.to_thread(server.get, "/livez"):
        verdict.decoders_replaced = sum(
            server.metric("unbend_worker_restarts_total", reason=f"decoder_{reason}")
            for reason in ("crashed", "killed", "exhausted")
        )
    return verdict


async def prepare(server: Server) -> None:
    """Stores the grid that cases name."""
    senders = Senders(server.http, server.grpc)
    assert await senders.send(HttpCase(b"POST /v1/grids HTTP/1.1\r\n", grids()[0])) is None
    await senders.close()
