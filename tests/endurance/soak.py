"""Hours of mixed work, a tenth of it given up in the middle; what was taken has to be given back."""

from __future__ import annotations

import http.client
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from random import Random

import grpc

import unbend
from benchmarks.material import barrel_grid, frames, jpeg, photograph
from benchmarks.serving import served
from tests.endurance.holding import Holdings
from tests.endurance.verdict import Verdict
from tests.endurance.watching import Watched, wait_for
from unbend.v1 import correction_pb2, correction_pb2_grpc, frame_pb2
from unbend_service.domain.frames import PixelFormat

LOADS = 4
CANCELLED_SHARE = 0.1
#: Work between two looks at what is held at rest, and how long memory takes to be given back.
SPELL_S, _REST_S = 150.0, 12.0
WIDTH, HEIGHT = 640, 360


def run(seconds: float, renderer: str) -> Verdict:
    """Works for ``seconds``, lets the service come to rest now and then, and compares with how it was at first."""
    verdict = Verdict("soak")
    done: Counter[str] = Counter()
    failures: list[str] = []
    with served(renderer=renderer, workers=2, known_images=64, grid_store_entries=256) as service:
        watched = Watched(service)
        wait_for(lambda: watched.workers_ready() == 2, 30)
        _work(service.http, service.grpc, min(20.0, seconds / 4))  # caches, threads and pools come to be
        _rest(watched)
        before = watched.descriptors(), watched.shared_bytes()
        holdings = Holdings(watched)
        holdings.look()
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > _REST_S:
            worked, failed = _work(service.http, service.grpc, min(SPELL_S, left_s))
            done += worked
            failures += failed
            _rest(watched, before[0])
            holdings.look()
        cancelled = sum(count for name, count in done.items() if name.endswith("given up"))
        total = sum(done.values())
        verdict.say(f"{seconds:g} s, {total} calls and streams, {cancelled / max(1, total):.1%} of them given up")
        for failure in failures[:20]:
            print("  ", failure)
        verdict.say(f"{len(failures)} failed", not failures)
        holdings.judge(verdict, seconds)
        descriptors, shared = watched.descriptors(), watched.shared_bytes()
        verdict.say(f"descriptors {before[0]} before, {descriptors} after", descriptors <= before[0])
        verdict.say(f"shared memory {before[1] >> 20} MiB before, {shared >> 20} MiB after", shared <= before[1])
        readiness = watched.readiness()
        verdict.say(
            f"{readiness['streams']} streams, {readiness['active']} calls, {readiness['queued']} frames open",
            readiness["streams"] == readiness["active"] == readiness["queued"] == 0,
        )
        restarts = watched.metric("unbend_worker_restarts_total")
        verdict.say(f"{restarts:g} workers restarted", restarts == 0)
    return verdict


def _rest(watched: Watched, descriptors: int | None = None) -> None:
    """Waits until nothing is under way, and what is kept for the next picture has been given back."""
    rested_s = time.monotonic() + _REST_S
    wait_for(lambda: _at_rest(watched) and (descriptors is None or watched.descriptors() <= descriptors), 30)
    time.sleep(max(0.0, rested_s - time.monotonic()))


def _at_rest(watched: Watched) -> bool:
    readiness = watched.readiness()
    return bool(readiness["streams"] == readiness["active"] == readiness["queued"] == watched.shared_bytes() == 0)


def _work(http: str, address: str, seconds: float) -> tuple[Counter[str], list[str]]:
    """Lets all loads work; returns what they did, and what failed."""
    done: Counter[str] = Counter()
    failures: list[str] = []
    end_s = time.monotonic() + seconds
    loads = [
        threading.Thread(target=_load, args=(http, address, end_s, Random(n), done, failures)) for n in range(LOADS)
    ]
    for load in loads:
        load.start()
    for load in loads:
        load.join()
    return done, failures


def _load(
    http_address: str, address: str, end_s: float, random: Random, done: Counter[str], failures: list[str]
) -> None:
    work = _Work(http_address, address, random)
    kinds: list[Callable[[bool], None]] = [work.correct, work.estimate, work.overlay, work.grid, work.raw, work.stream]
    while time.monotonic() < end_s:
        kind = random.choice(kinds)
        given_up = random.random() < CANCELLED_SHARE
        try:
            kind(given_up)
        except Exception as error:
            failures.append(f"{kind.__name__}{' given up' if given_up else ''}: {error!r}")
        done[f"{kind.__name__}{' given up' if given_up else ''}"] += 1
        time.sleep(random.uniform(0, 0.05))
    work.close()


class _Work:
    """One of each kind of call, from its beginning to its end or until it is given up."""

    def __init__(self, http_address: str, address: str, random: Random) -> None:
        self._http = http_address
        self._random = random
        self._client = unbend.Client(address, timeout_s=60)
        self._channel = grpc.insecure_channel(address)
        self._correction = correction_pb2_grpc.CorrectionServiceStub(self._channel)
        self._record = self._client.grids.put(unbend.Grid(barrel_grid().source))
        self._frames = [frame.data.reshape(-1, WIDTH) for frame in frames(PixelFormat.I420, WIDTH, HEIGHT, 4)]
        self._bodies = [
            jpeg(photograph(*size, seed)) for seed, size in enumerate([(640, 480), (1280, 720), (400, 600)])
        ]

    def close(self) -> None:
        self._client.close()
        self._channel.close()

    def correct(self, given_up: bool) -> None:
        path = self._random.choice(
            ["", "?fit=full", "?strength=0.5", "?format=png", f"?grid_id={self._record.grid_id}"]
        )
        self._post(f"/v1/correct{path}", given_up)

    def estimate(self, given_up: bool) -> None:
        self._post("/v1/estimate", given_up)

    def overlay(self, given_up: bool) -> None:
        self._post(f"/v1/overlay?what={self._random.choice(['guides', 'grid', 'displacement'])}", given_up)

    def grid(self, given_up: bool) -> None:
        self._call("GET", f"/v1/grids/{self._record.grid_id}", None, given_up)

    def raw(self, given_up: bool) -> None:
        request = correction_pb2.CorrectRequest(
            format=frame_pb2.FrameFormat(pixel_format=frame_pb2.PIXEL_FORMAT_I420, width=WIDTH, height=HEIGHT),
            data=self._frames[self._random.randrange(4)].tobytes(),
            grid_id=self._record.grid_id,
        )
        call = self._correction.Correct.future(request, timeout=60)
        if given_up:
            time.sleep(self._random.uniform(0, 0.02))
            call.cancel()
        else:
            call.result()

    def stream(self, given_up: bool) -> None:
        last = self._random.randrange(1, 20) if given_up else None
        source = self._record if self._random.random() < 0.7 else None
        with self._client.stream(WIDTH, HEIGHT, "i420", grid=source) as stream:
            for result in stream.correct(self._frames[n % 4] for n in range(30)):
                if result.image is None:
                    raise RuntimeError(f"{result.status} {result.error}")
                if result.index == last:
                    return

    def _post(self, path: str, given_up: bool) -> None:
        body = self._random.choice(self._bodies)
        if self._random.random() < 0.3:
            body += self._random.randbytes(8)  # another file with the same picture
        self._call("POST", path, body, given_up)

    def _call(self, method: str, path: str, body: bytes | None, given_up: bool) -> None:
        connection = http.client.HTTPConnection(self._http, timeout=60)
        try:
            if given_up and body is not None and self._random.random() < 0.5:
                with suppress(OSError):
                    connection.putrequest(method, path)
                    connection.putheader("Content-Length", str(len(body)))
                    connection.endheaders(body[: len(body) // 2])
                return
            connection.request(method, path, body)
            if given_up:
                time.sleep(self._random.uniform(0, 0.05))
                return
            response = connection.getresponse()
            answer = response.read()
            if response.status != 200:
                raise RuntimeError(f"{response.status}: {answer[:200]!r}")
        finally:
            connection.close()
