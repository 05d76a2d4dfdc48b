"""Three times the pictures that the service can do, arriving by the clock: most are refused, and at once."""

from __future__ import annotations

import http.client
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np

import unbend
from benchmarks.material import barrel_grid, jpeg, photograph
from benchmarks.serving import served
from tests.endurance.verdict import TIMED_FROM_S, Verdict
from tests.endurance.watching import Watched, wait_for

FACTOR = 3.0
REJECTED_BAR_S, ACCEPTED_BAR = 0.05, 2.0
#: Half of them single calls: two under way at once, on two cores.
QUEUE_FRAMES = 4
CLIENTS = 64


@dataclass
class Arrivals:
    """How calls that came by the clock were answered; seconds from the moment each was due."""

    accepted_s: list[float] = field(default_factory=list)
    rejected_s: list[float] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    without_pause: int = 0


def run(seconds: float, renderer: str) -> Verdict:
    """Measures what the service can do, how long a call takes at a third of it, and then at three times of it."""
    verdict = Verdict("overload", timed=seconds >= TIMED_FROM_S)
    body = jpeg(photograph(1280, 720))
    with served(renderer=renderer, workers=2, queue_frames=QUEUE_FRAMES) as service:
        watched = Watched(service)
        wait_for(lambda: watched.workers_ready() == 2, 30)
        with unbend.Client(service.grpc) as client:
            path = f"/v1/correct?grid_id={client.grids.put(unbend.Grid(barrel_grid().source)).grid_id}"
        _capacity(service.http, path, body, 2.0)
        capacity = _capacity(service.http, path, body, max(3.0, seconds / 6))
        calm = _arrive(service.http, path, body, capacity / 3, max(5.0, seconds / 3))
        storm = _arrive(service.http, path, body, FACTOR * capacity, max(5.0, seconds / 2))
    for failure in (*calm.failures, *storm.failures)[:10]:
        print("  ", failure)
    unloaded_s = float(np.quantile(calm.accepted_s, 0.99))
    accepted_s = float(np.quantile(storm.accepted_s, 0.99))
    rejected_s = float(np.quantile(storm.rejected_s or [9.0], 0.99))
    verdict.say(f"{capacity:.0f} pictures/s fit, {FACTOR * capacity:.0f}/s came", capacity > 0)
    verdict.say(
        f"{len(storm.accepted_s)} accepted, {len(storm.rejected_s)} rejected, {len(storm.failures)} failed, "
        f"{storm.without_pause} rejected without Retry-After",
        bool(storm.accepted_s and storm.rejected_s) and not storm.failures and not storm.without_pause,
    )
    verdict.say_time(
        f"rejects answered: median {np.median(storm.rejected_s or [9.0]) * 1e3:.0f} ms, p99 {rejected_s * 1e3:.0f} ms "
        f"(under {REJECTED_BAR_S * 1e3:.0f})",
        rejected_s < REJECTED_BAR_S,
    )
    ratio = accepted_s / unloaded_s
    verdict.say_time(
        f"accepted p99 {accepted_s * 1e3:.0f} ms, {ratio:.1f} times the {unloaded_s * 1e3:.0f} ms at a third of "
        f"the load (at most {ACCEPTED_BAR:g})",
        ratio <= ACCEPTED_BAR,
    )
    return verdict


def _capacity(address: str, path: str, body: bytes, seconds: float) -> float:
    """Pictures a second of two callers who wait for each answer."""
    done: list[float] = []
    end_s = time.monotonic() + seconds

    def call() -> None:
        connection = http.client.HTTPConnection(address, timeout=60)
        while time.monotonic() < end_s:
            if _post(connection, path, body)[0] == 200:
                done.append(time.monotonic())
        connection.close()

    callers = [threading.Thread(target=call) for _ in range(QUEUE_FRAMES // 2)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    return len(done) / seconds


def _arrive(address: str, path: str, body: bytes, rate: float, seconds: float) -> Arrivals:
    """Sends calls at ``rate`` a second whether or not those before them were answered."""
    arrivals = Arrivals()
    own = threading.local()

    def call(due_s: float) -> None:
        if not hasattr(own, "connection"):
            own.connection = http.client.HTTPConnection(address, timeout=60)
        try:
            status, retry_after = _post(own.connection, path, body)
        except (OSError, http.client.HTTPException) as error:
            own.connection.close()
            arrivals.failures.append(repr(error))
            return
        taken_s = time.monotonic() - due_s
        if status == 200:
            arrivals.accepted_s.append(taken_s)
        elif status == 429:
            arrivals.rejected_s.append(taken_s)
            arrivals.without_pause += retry_after is None
        else:
            arrivals.failures.append(f"status {status}")

    start_s = time.monotonic()
    with ThreadPoolExecutor(CLIENTS) as callers:
        for number in range(int(rate * seconds)):
            due_s = start_s + number / rate
            time.sleep(max(0.0, due_s - time.monotonic()))
            callers.submit(call, time.monotonic())
    return arrivals


def _post(connection: http.client.HTTPConnection, path: str, body: bytes) -> tuple[int, str | None]:
    connection.request("POST", path, body, {"content-type": "image/jpeg"})
    response = connection.getresponse()
    response.read()
    return response.status, response.headers.get("Retry-After")
