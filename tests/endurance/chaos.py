"""Streams whose render workers are killed every few seconds, stopped, and crashed."""

from __future__ import annotations

import os
import signal
import threading
import time
from random import Random

import numpy as np

from benchmarks.material import barrel_grid
from benchmarks.serving import served
from tests.endurance.checked_streams import CheckedStream
from tests.endurance.verdict import TIMED_FROM_S, Verdict
from tests.endurance.watching import Watched, wait_for

KILL_EVERY_S = 5.0
HANG_S = 2.0
STALL_BAR_S = 2.0
RATE = 8.0
STOPS = 3
STORM_CRASHES = 5
STREAMS = [
    ("i420", (640, 360), "lossless"),
    ("nv12", (640, 360), "lossless"),
    ("rgb24", (480, 270), "lossless"),
    ("bgr24", (320, 240), "lossless"),
    ("rgba", (320, 240), "lossless"),
    ("gray8", (800, 600), "lossless"),
    ("i420", (1280, 720), "lossless"),
    ("jpeg", (640, 360), "lossless"),
    ("i420", (640, 360), "latest"),
    ("jpeg", (480, 270), "latest"),
]


def run(seconds: float, renderer: str) -> Verdict:
    """Kills for ``seconds``, then stops workers while the streams go on, then a storm."""
    verdict = Verdict("chaos", timed=seconds >= TIMED_FROM_S)
    random = Random(1)
    grid = barrel_grid()
    stop = threading.Event()
    with served(renderer=renderer, workers=2, hang_s=HANG_S) as service:
        watched = Watched(service)
        wait_for(lambda: watched.workers_ready() == 2, 30)
        streams = [
            CheckedStream(
                service.grpc, grid, kind, size, rate=RATE, stop=stop, seed=n, delivery=how, exact=renderer == "cpu"
            )
            for n, (kind, size, how) in enumerate(STREAMS)
        ]
        for stream in streams:
            stream.start()
        time.sleep(2)
        kills_s = _kill(watched, seconds, random)
        wait_for(lambda: watched.workers_ready() == 2, 30)
        replaced_s = [_stop_one(watched, random) for _ in range(STOPS)]
        stop.set()
        for stream in streams:
            stream.join(120)
        _judge_streams(verdict, streams, kills_s, seconds)
        worst_s = max(replaced_s)
        verdict.say_time(
            f"{STOPS} workers stopped, replaced within {worst_s:.2f} s (at most {HANG_S:g} + 2)", worst_s <= HANG_S + 2
        )
        _judge_service(verdict, watched, len(streams), len(kills_s) + STOPS)
        _judge_storm(verdict, watched)
    return verdict


def _kill(watched: Watched, seconds: float, random: Random) -> list[float]:
    """Kills a worker every few seconds; returns when."""
    kills_s: list[float] = []
    due_s = time.monotonic()
    end_s = due_s + seconds
    while due_s < end_s:
        time.sleep(max(0.0, due_s - time.monotonic()))
        if workers := watched.workers():
            kills_s.append(time.monotonic())
            random.choice(workers).kill()
        due_s += KILL_EVERY_S
    time.sleep(max(0.0, end_s - time.monotonic()))
    return kills_s


def _stop_one(watched: Watched, random: Random) -> float:
    """Stops a worker; returns after how many seconds it was gone and another was ready in its place."""
    worker = random.choice(watched.workers())
    os.kill(worker.pid, signal.SIGSTOP)
    start_s = time.monotonic()
    wait_for(lambda: worker.pid not in {w.pid for w in watched.workers()} and watched.workers_ready() == 2, 30)
    return time.monotonic() - start_s


def _judge_streams(verdict: Verdict, streams: list[CheckedStream], kills_s: list[float], seconds: float) -> None:
    tallies = [stream.tally for stream in streams]
    sent, corrected = sum(t.sent for t in tallies), sum(t.corrected for t in tallies)
    lost, reordered = sum(t.lost for t in tallies), sum(t.reordered for t in tallies)
    wrong, dropped = sum(t.wrong for t in tallies), sum(t.dropped for t in tallies)
    errors = [f"{stream.name}: {error}" for stream in streams for error in stream.tally.errors]
    for error in errors[:20]:
        print("  ", error)
    verdict.say(f"{seconds:g} s, {len(streams)} streams, {len(kills_s)} workers killed, {sent} frames", corrected > 0)
    verdict.say(
        f"{lost} lost, {reordered} duplicated or reordered, {wrong} wrong pictures, {len(errors)} errors",
        lost == reordered == wrong == len(errors) == 0,
    )
    lossless = [stream.tally for stream, (_, _, how) in zip(streams, STREAMS, strict=True) if how == "lossless"]
    verdict.say(f"{dropped} dropped by latest delivery, none by lossless", not any(t.dropped for t in lossless))
    stalls = [_longest_gap(tally.answered_s, kill_s) for tally in tallies for kill_s in kills_s]
    p99_s = float(np.quantile(stalls, 0.99))
    verdict.say_time(
        f"stall after a kill: median {np.median(stalls):.2f} s, p99 {p99_s:.2f} s (under {STALL_BAR_S:g}), "
        f"most {max(stalls):.2f} s",
        p99_s < STALL_BAR_S,
    )


def _longest_gap(answered_s: list[float], kill_s: float) -> float:
    """The longest time between two answers of a stream, the later of which came within the kill's own five seconds."""
    times = np.array([t for t in answered_s if kill_s - 1 < t < kill_s + KILL_EVERY_S])
    if len(times) < 2:
        return KILL_EVERY_S
    return float(np.diff(times)[times[1:] > kill_s].max(initial=0.0))


def _judge_service(verdict: Verdict, watched: Watched, streams: int, deaths: int) -> None:
    ended = watched.metric("unbend_requests_total", method="CorrectionService/CorrectStream")
    fine = watched.metric("unbend_requests_total", method="CorrectionService/CorrectStream", code="OK")
    verdict.say(f"{fine:g} of {ended:g} stream calls ended well, none was opened twice", ended == fine == streams)
    restarts = watched.metric("unbend_worker_restarts_total")
    verdict.say(f"{restarts:g} restarts for {deaths} deaths", restarts == deaths)


def _judge_storm(verdict: Verdict, watched: Watched) -> None:
    """Workers that crash by themselves, five within a minute, make the service unready, and it says why."""
    for _ in range(STORM_CRASHES):
        wait_for(lambda: watched.workers_ready() == 2, 30)
        if not watched.readiness()["ready"]:
            break
        crashing = watched.workers()[0].pid
        os.kill(crashing, signal.SIGSEGV)
        wait_for(lambda gone=crashing: gone not in {w.pid for w in watched.workers()}, 10)
    wait_for(lambda: not watched.readiness()["ready"], 5)
    readiness = watched.readiness()
    verdict.say(f"storm guard: {' '.join(readiness['reasons']) or 'ready in spite of it'}", not readiness["ready"])
