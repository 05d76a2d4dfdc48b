"""Corrected photographs over HTTP, one after the other and by many clients at once."""

from __future__ import annotations

import argparse
import http.client
import threading
import time
from dataclasses import asdict

import cv2
import numpy as np
import simplejpeg

import unbend
from benchmarks.material import BareRemap, barrel_grid, jpeg, photograph
from benchmarks.measurement import Report, Timing, by_turns
from benchmarks.serving import Served, served
from unbend_service.adapters.cores import usable_cores
from unbend_service.application.fitting import fitted
from unbend_service.domain.fit import CROP
from unbend_service.domain.frames import Frame, PixelFormat

BAR = 1.20


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the suite."""
    parser.add_argument("--runs", type=int, default=11, help="turns")
    parser.add_argument("--clients", type=int, default=16, help="clients at once")


def run(arguments: argparse.Namespace) -> Report:
    """/v1/correct of a JPEG whose grid is known, beside decode, cv2.remap and encode by hand."""
    report = Report("http")
    runs = 3 if arguments.quick else arguments.runs
    width, height = (1920, 1080) if arguments.quick else (4000, 3000)
    body = jpeg(photograph(width, height))
    grid = barrel_grid()
    cv2.setNumThreads(usable_cores())
    blank = Frame(PixelFormat.RGBA, width, height, np.zeros(4 * width * height, np.uint8))
    bare = BareRemap(blank, fitted(grid, CROP, 1.0))

    def by_hand() -> bytes:
        pixels = simplejpeg.decode_jpeg(body, colorspace="RGBA")
        drawn = bare(Frame(PixelFormat.RGBA, width, height, pixels.reshape(-1)))
        return bytes(simplejpeg.encode_jpeg(drawn.reshape(height, width, 4), 92, "RGBA", "420"))

    with served(renderer="cpu") as service:
        connection = http.client.HTTPConnection(service.http)
        with unbend.Client(service.grpc) as client:
            grid_id = client.grids.put(unbend.Grid(grid.source)).grid_id
        path = f"/v1/correct?quality=92&grid_id={grid_id}"
        pair = by_turns(lambda: _post(connection, path, body), by_hand, runs)
        name = f"HTTP /v1/correct, {width}x{height} JPEG, known grid"
        report.add_pair(name, pair, peer_name="simplejpeg and cv2.remap in process")
        report.add_ratio(f"{name} / in process", pair.ratio, at_most=BAR)
        connection.close()
        _together(report, service, path, 3 if arguments.quick else 6, 4 if arguments.quick else arguments.clients)
    return report


def _together(report: Report, service: Served, path: str, each: int, clients: int) -> None:
    body = jpeg(photograph(1920, 1080))
    seconds: list[float] = []
    errors: list[str] = []

    def one() -> None:
        connection = http.client.HTTPConnection(service.http)
        try:
            for _ in range(each):
                start = time.perf_counter()
                _post(connection, path, body)
                seconds.append(time.perf_counter() - start)
        except Exception as error:  # whatever it is, it counts as an error of the load
            errors.append(repr(error))
        finally:
            connection.close()

    threads = [threading.Thread(target=one) for _ in range(clients)]
    start = time.perf_counter()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    rate = len(seconds) / (time.perf_counter() - start)
    p99_s = float(np.quantile(seconds, 0.99))
    timing = Timing.of(seconds)
    report.rows.append(
        {
            "name": f"{clients} clients at once, 1080p JPEG",
            "ours": asdict(timing),
            "per_s": rate,
            "p99_s": p99_s,
            "errors": errors,
        }
    )
    print(f"{clients} clients: {rate:.1f} pictures/s, {timing}, p99 {p99_s * 1e3:.0f} ms, {len(errors)} errors")
    report.add_ratio(f"errors of {clients} clients at once", len(errors), at_most=0)


def _post(connection: http.client.HTTPConnection, path: str, body: bytes) -> bytes:
    connection.request("POST", path, body, {"content-type": "image/jpeg"})
    response = connection.getresponse()
    answer = response.read()
    if response.status != 200:
        raise RuntimeError(f"{response.status}: {answer[:200]!r}")
    return answer
