"""Round trips of estimates over HTTP and gRPC, of pictures that were not seen before."""

from __future__ import annotations

import argparse
import asyncio
import http.client
import statistics
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict
from typing import Any
from unittest.mock import patch

from onnxruntime import InferenceSession

import unbend
from benchmarks.material import bent, jpeg, photograph
from benchmarks.measurement import Report, Timing, by_turns
from benchmarks.serving import Served, served
from unbend_service.adapters.codecs.pillow import PillowCodec
from unbend_service.adapters.cores import usable_cores
from unbend_service.adapters.estimators import lineset
from unbend_service.adapters.estimators.catalogue import load_estimator
from unbend_service.application.estimation import ESTIMATE_LONGEST_PX
from unbend_service.cli.private import private_service
from unbend_service.domain.decision import TRUSTING, decide
from unbend_service.domain.records import Correct
from unbend_service.settings import Settings

BAR_S = 0.040
#: What the line-set estimator calls, and the part that it belongs to.
_PARTS = {
    "fit_long_side": "edge chains",
    "extract": "edge chains",
    "describe": "description of the chains",
    "refine": "radial lenses",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the suite."""
    parser.add_argument("--runs", type=int, default=25, help="turns")


def run(arguments: argparse.Namespace) -> Report:
    """1080p JPEGs, each its own; the same use case in process is the peer, the difference is the network's share."""
    report = Report("estimate")
    runs = 4 if arguments.quick else arguments.runs
    body = jpeg(photograph(1920, 1080))
    number = iter(range(1_000_000))

    def fresh() -> bytes:
        # what follows the end of a JPEG is not decoded, but makes it another file
        return body + next(number).to_bytes(4)

    settings = Settings(known_images=0)
    with served(known_images=0) as service, unbend.Client(service.grpc) as client, asyncio.Runner() as runner:
        context = private_service(settings, renders=False)
        inside = runner.run(context.__aenter__())
        try:
            local = lambda: runner.run(inside.estimation.of_image(fresh()))  # noqa: E731 one line, used thrice
            connection = http.client.HTTPConnection(service.http)
            pair = by_turns(lambda: _post(connection, fresh()), local, runs)
            report.add_pair("HTTP /v1/estimate, 1080p JPEG", pair, peer_name="in process")
            report.add_ratio("HTTP round trip, s", pair.ours.median_s, at_most=BAR_S)
            share = 1 - 1 / pair.ratio
            report.rows.append({"name": "the network's share of HTTP", "share": share})
            pair = by_turns(lambda: client.estimate(fresh()), local, runs)
            report.add_pair("gRPC Estimate, 1080p JPEG", pair, peer_name="in process")
            report.add_ratio("gRPC round trip, s", pair.ours.median_s, at_most=BAR_S)
            report.rows.append({"name": "the network's share of gRPC", "share": 1 - 1 / pair.ratio})
            print(f"the network's share: HTTP {share:.0%}, gRPC {1 - 1 / pair.ratio:.0%}", flush=True)
            body = jpeg(bent(photograph(1920, 1080)))
            pair = by_turns(lambda: _post(connection, fresh()), local, runs)
            report.add_pair("HTTP /v1/estimate, 1080p JPEG bent by a lens", pair, peer_name="in process")
            body = jpeg(photograph(1920, 1080))
            connection.close()
            _parts(report, body, runs, settings)
        finally:
            runner.run(context.__aexit__(None, None, None))
    with served() as service:
        _known(report, service, body, runs)
    return report


def _parts(report: Report, body: bytes, runs: int, settings: Settings) -> None:
    """Where the time of one estimate in process goes, if the line-set estimator makes it."""
    estimator = load_estimator(settings.model, settings.estimator_threads or usable_cores())
    if not isinstance(estimator, lineset.LinesetEstimator):
        return
    codec, spent = PillowCodec(settings), Spent()
    with ExitStack() as patches:
        for name, part in _PARTS.items():
            patches.enter_context(patch.object(lineset, name, spent.timed(part, getattr(lineset, name))))
        networks = spent.timed("networks", InferenceSession.run)
        patches.enter_context(patch.object(InferenceSession, "run", networks))
        for _ in range(runs):
            grey = spent.timed("luma at half size", codec.decode_grey)(body, ESTIMATE_LONGEST_PX)
            estimate = spent.timed("the estimator, of which", estimator.estimate)(grey)
            spent.timed("decision and grid", decide)(
                estimate.guides,
                estimate.confidence,
                estimate.confidence_kind,
                estimate.model.name,
                correct=Correct.NONLINEAR,
                caution=TRUSTING,
                points=settings.grid_points,
            )
            spent.end_turn()
    whole = (
        spent.median_s("luma at half size")
        + spent.median_s("the estimator, of which")
        + spent.median_s("decision and grid")
    )
    inside = [part for part in spent.turns[0] if part in {*_PARTS.values(), "networks"}]
    for part in ["luma at half size", "the estimator, of which", *inside, "decision and grid"]:
        share = spent.median_s(part) / whole
        report.rows.append({"name": f"of an estimate: {part}", "share": share})
        print(f"of an estimate: {part} {spent.median_s(part) * 1e3:.1f} ms, {share:.0%}", flush=True)


class Spent:
    """Seconds by part, turn by turn.

    Attributes:
        turns: of each turn that has ended, the seconds of each part.
    """

    def __init__(self) -> None:
        self.turns: list[dict[str, float]] = []
        self._turn: dict[str, float] = {}

    def timed(self, part: str, work: Callable[..., Any]) -> Callable[..., Any]:
        """``work``, whose time goes to ``part``."""

        def run(*arguments: Any, **options: Any) -> Any:
            start = time.perf_counter()
            try:
                return work(*arguments, **options)
            finally:
                self._turn[part] = self._turn.get(part, 0.0) + time.perf_counter() - start

        return run

    def end_turn(self) -> None:
        """What follows belongs to the next turn."""
        self.turns.append(self._turn)
        self._turn = {}

    def median_s(self, part: str) -> float:
        """Over the turns that have ended."""
        return statistics.median(turn.get(part, 0.0) for turn in self.turns)


def _known(report: Report, service: Served, body: bytes, runs: int) -> None:
    connection = http.client.HTTPConnection(service.http)
    _post(connection, body)
    seconds = []
    for _ in range(runs):
        start = time.perf_counter()
        _post(connection, body)
        seconds.append(time.perf_counter() - start)
    connection.close()
    report.rows.append({"name": "HTTP /v1/estimate, a known picture", "ours": asdict(Timing.of(seconds))})
    print(f"HTTP /v1/estimate, a known picture: {Timing.of(seconds)}", flush=True)


def _post(connection: http.client.HTTPConnection, body: bytes) -> bytes:
    connection.request("POST", "/v1/estimate", body, {"content-type": "image/jpeg"})
    response = connection.getresponse()
    answer = response.read()
    if response.status != 200:
        raise RuntimeError(f"{response.status}: {answer[:200]!r}")
    return answer
