"""Round trips of estimates over HTTP and gRPC, of pictures that were not seen before."""

from __future__ import annotations

import argparse
import asyncio
import http.client
import time
from dataclasses import asdict

import unbend
from benchmarks.material import jpeg, photograph
from benchmarks.measurement import Report, Timing, by_turns
from benchmarks.serving import Served, served
from unbend_service.cli.private import private_service
from unbend_service.settings import Settings

BAR_S = 0.040


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
            connection.close()
        finally:
            runner.run(context.__aexit__(None, None, None))
    with served() as service:
        _known(report, service, body, runs)
    return report


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
