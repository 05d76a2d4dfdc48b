"""Streams of 1080p frames beside a bare echo, the same work in one process, and ffmpeg's remap filter."""

from __future__ import annotations

import argparse
import shutil
import subprocess
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import grpc
import numpy as np
import psutil
import simplejpeg

import unbend
from benchmarks.echo import METHOD, echo_served
from benchmarks.material import BareRemap, barrel_grid, frames, jpeg, photograph
from benchmarks.measurement import Report, Timing, by_turns
from benchmarks.render import Pool
from benchmarks.serving import Served, served
from unbend._channel import open_channel
from unbend_service.adapters.cores import usable_cores
from unbend_service.application.fitting import fitted
from unbend_service.domain.fit import KEEP
from unbend_service.domain.frames import Frame, PixelFormat
from unbend_service.domain.grid import Grid

WIDTH, HEIGHT = 1920, 1080
IN_FLIGHT = 8
BAR_ECHO, BAR_JPEG, BAR_FFMPEG, BAR_SHARED = 0.80, 0.80, 1.3, 0.85
DISTINCT = 8


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the suite."""
    parser.add_argument("--runs", type=int, default=7, help="turns a case")
    parser.add_argument("--frames", type=int, default=48, help="frames a turn")
    parser.add_argument("--streams", type=int, nargs="*", default=(1, 4, 16, 64), help="streams at once")


def run(arguments: argparse.Namespace) -> Report:
    """Frames a second of whole streams, whose grid is known, measured at the client."""
    report = Report("stream")
    runs, count = (2, 4) if arguments.quick else (arguments.runs, arguments.frames)
    cv2.setNumThreads(usable_cores())
    grid = barrel_grid()
    with (
        tempfile.TemporaryDirectory() as folder,
        served(renderer="cpu", local_socket=f"{folder}/frames.sock") as service,
    ):
        # the memory is made, and met page by page, with each stream: in one of seconds that is spread over its frames
        _shared(report, service, f"{folder}/frames.sock", grid, runs, 4 * count)
        _raw(report, service, grid, runs, count)
        _jpeg(report, service, grid, runs, count)
        _spent(report, service, f"{folder}/frames.sock", grid, count)
        for streams in (2,) if arguments.quick else arguments.streams:
            _together(report, service, grid, streams, max(2, count // streams))
    return report


def _raw(report: Report, service: Served, grid: Grid, runs: int, count: int) -> None:
    batch = frames(PixelFormat.I420, WIDTH, HEIGHT, DISTINCT)
    arrays = [frame.data.reshape(HEIGHT * 3 // 2, WIDTH) for frame in batch]
    bare = BareRemap(batch[0], grid)
    with unbend.Client(service.grpc) as client, echo_served() as address, open_channel(address, None) as channel:
        record = client.grids.put(unbend.Grid(grid.source))

        def ours() -> None:
            with client.stream(WIDTH, HEIGHT, "i420", grid=record, fit="keep", in_flight=IN_FLIGHT) as stream:
                _drain(stream.correct(arrays[n % DISTINCT] for n in range(count)), count)

        def remap() -> None:
            for n in range(count):
                bare(batch[n % DISTINCT])

        def echo() -> None:
            _echo(channel, arrays, count)

        def echo_and_remap() -> None:
            echo()
            remap()

        pair = by_turns(ours, echo, runs, warm_up=1)
        _add(report, "raw i420 stream over gRPC", pair.per(count), "tuned bare gRPC echo")
        report.add_ratio("raw i420 stream / bare echo, frames/s", 1 / pair.ratio, at_least=BAR_ECHO)
        pair = by_turns(ours, echo_and_remap, runs, warm_up=1)
        _add(report, "raw i420 stream over gRPC", pair.per(count), "bare echo and then bare cv2.remap")
        if shutil.which("ffmpeg") is None:
            print("ffmpeg is not here and is left out", flush=True)
            return
        with tempfile.TemporaryDirectory() as folder:
            command = _ffmpeg(Path(folder), grid, batch, count)
            pair = by_turns(remap, lambda: subprocess.run(command, check=True), runs, warm_up=1)
            _add(report, "bare cv2.remap, i420, for comparison", pair.per(count), "ffmpeg remap filter")
            pair = by_turns(ours, lambda: subprocess.run(command, check=True), runs, warm_up=1)
            _add(report, "raw i420 stream over gRPC", pair.per(count), "ffmpeg remap filter")
            report.add_ratio("raw i420 stream / ffmpeg remap filter, frames/s", 1 / pair.ratio, at_least=BAR_FFMPEG)


def _shared(report: Report, service: Served, socket: str, grid: Grid, runs: int, count: int) -> None:
    """Raw frames through memory that is shared with the service, beside a pool that is called in this process."""
    batch = frames(PixelFormat.I420, WIDTH, HEIGHT, DISTINCT)
    arrays = [frame.data.reshape(HEIGHT * 3 // 2, WIDTH) for frame in batch]
    pool = Pool("cpu", usable_cores())
    with unbend.Client(service.grpc, shared_memory=socket) as sharing, unbend.Client(service.grpc) as client:
        record = client.grids.put(unbend.Grid(grid.source))

        def through(face: unbend.Client) -> None:
            with face.stream(WIDTH, HEIGHT, "i420", grid=record, fit="keep", in_flight=IN_FLIGHT) as stream:
                _drain(stream.correct(arrays[n % DISTINCT] for n in range(count)), count)

        def alone() -> None:
            pool.many([batch[n % DISTINCT] for n in range(count)], grid, IN_FLIGHT)

        pair = by_turns(lambda: through(sharing), alone, runs, warm_up=1)
        _add(report, "raw i420 stream over shared memory", pair.per(count), "the pool alone, in process")
        report.add_ratio("raw i420 stream over shared memory / pool, frames/s", 1 / pair.ratio, at_least=BAR_SHARED)
        pair = by_turns(lambda: through(sharing), lambda: through(client), runs, warm_up=1)
        _add(report, "raw i420 stream over shared memory", pair.per(count), "the same over gRPC alone")
    pool.close()


def _jpeg(report: Report, service: Served, grid: Grid, runs: int, count: int) -> None:
    files = [jpeg(photograph(WIDTH, HEIGHT, seed)) for seed in range(4)]
    frame = Frame(PixelFormat.RGBA, WIDTH, HEIGHT, np.zeros(4 * WIDTH * HEIGHT, np.uint8))
    bare = BareRemap(frame, fitted(grid, KEEP, 1.0))

    def one(body: bytes) -> bytes:
        pixels = simplejpeg.decode_jpeg(body, colorspace="RGBA")
        drawn = bare(Frame(PixelFormat.RGBA, WIDTH, HEIGHT, pixels.reshape(-1)))
        return bytes(simplejpeg.encode_jpeg(drawn.reshape(HEIGHT, WIDTH, 4), 92, "RGBA", "420"))

    def in_process() -> None:
        # as many frames at once as there are cores: all three steps leave the interpreter free
        waiting = iter([files[n % len(files)] for n in range(count)])
        lock = threading.Lock()

        def work() -> None:
            while True:
                with lock:
                    body = next(waiting, None)
                if body is None:
                    return
                one(body)

        threads = [threading.Thread(target=work) for _ in range(usable_cores())]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    with unbend.Client(service.grpc) as client:
        record = client.grids.put(unbend.Grid(grid.source))

        def ours() -> None:
            with client.stream(pixel_format="jpeg", grid=record, fit="keep", quality=92, in_flight=IN_FLIGHT) as stream:
                _drain(stream.correct(files[n % len(files)] for n in range(count)), count)

        cv2.setNumThreads(1)
        pair = by_turns(ours, in_process, runs, warm_up=1)
        cv2.setNumThreads(usable_cores())
    _add(report, "jpeg 1080p stream over gRPC", pair.per(count), "decode, remap, encode in one process, all cores")
    report.add_ratio("jpeg stream / in process, frames/s", 1 / pair.ratio, at_least=BAR_JPEG)


def _spent(report: Report, service: Served, socket: str, grid: Grid, count: int) -> None:
    """Where the processor time of a frame goes: of each party, for each way that frames take, and for the echo."""
    arrays = [frame.data.reshape(HEIGHT * 3 // 2, WIDTH) for frame in frames(PixelFormat.I420, WIDTH, HEIGHT, DISTINCT)]
    files = [jpeg(photograph(WIDTH, HEIGHT, seed)) for seed in range(4)]
    parties = {"client": [psutil.Process()], "service": [psutil.Process(service.pid)], "workers": [], "decoders": []}
    for child in parties["service"][0].children():
        parties["workers" if any("renderers.worker" in part for part in child.cmdline()) else "decoders"].append(child)
    with (
        unbend.Client(service.grpc, shared_memory=socket) as sharing,
        unbend.Client(service.grpc) as client,
        echo_served() as address,
        open_channel(address, None) as channel,
    ):
        record = client.grids.put(unbend.Grid(grid.source))

        def raw(face: unbend.Client) -> None:
            with face.stream(WIDTH, HEIGHT, "i420", grid=record, fit="keep", in_flight=IN_FLIGHT) as stream:
                _drain(stream.correct(arrays[n % DISTINCT] for n in range(count)), count)

        def encoded() -> None:
            with client.stream(pixel_format="jpeg", grid=record, fit="keep", in_flight=IN_FLIGHT) as stream:
                _drain(stream.correct(files[n % len(files)] for n in range(count)), count)

        echo = {"client": parties["client"], "echo": [p for p in psutil.Process().children() if p.pid != service.pid]}
        cases: list[tuple[str, dict[str, list[psutil.Process]], Callable[[], None]]] = [
            ("bare gRPC echo", echo, lambda: _echo(channel, arrays, count)),
            ("raw i420 stream over gRPC", parties, lambda: raw(client)),
            ("raw i420 stream over shared memory", parties, lambda: raw(sharing)),
            ("jpeg 1080p stream over gRPC", parties, encoded),
        ]
        for name, those, work in cases:
            work()
            before = {party: _cpu_s(processes) for party, processes in those.items()}
            start = time.perf_counter()
            work()
            wall_ms = (time.perf_counter() - start) / count * 1e3
            spent = {f"{p}_cpu_ms": (_cpu_s(those[p]) - cpu_s) / count * 1e3 for p, cpu_s in before.items()}
            least_ms = sum(spent.values()) / usable_cores()
            row = {"name": f"{name}: processor time a frame", **spent, "least_ms": least_ms, "wall_ms": wall_ms}
            report.rows.append(row)
            parts = ", ".join(f"{party} {value:.1f}" for party, value in row.items() if party != "name")
            print(f"{row['name']}: {parts}", flush=True)


def _cpu_s(processes: list[psutil.Process]) -> float:
    return sum(sum(process.cpu_times()[:2]) for process in processes)


def _together(report: Report, service: Served, grid: Grid, streams: int, count: int) -> None:
    """Many streams of 640 x 360 at once: frames a second of all, and how long frames took."""
    width, height, count = 640, 360, count * 6
    arrays = [frame.data.reshape(height * 3 // 2, width) for frame in frames(PixelFormat.I420, width, height, 4)]
    seconds: list[float] = []

    def one() -> None:
        with unbend.Client(service.grpc, timeout_s=120) as client:
            record = client.grids.put(unbend.Grid(grid.source))
            sent: deque[float] = deque()

            def source() -> Iterator[unbend.Image]:
                for n in range(count):
                    sent.append(time.perf_counter())
                    yield arrays[n % len(arrays)]

            with client.stream(width, height, "i420", grid=record, in_flight=2) as stream:
                seconds.extend(time.perf_counter() - sent.popleft() for _ in stream.correct(source()))

    threads = [threading.Thread(target=one) for _ in range(streams)]
    start = time.perf_counter()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    rate = len(seconds) / (time.perf_counter() - start)
    if len(seconds) != streams * count:
        raise RuntimeError(f"{len(seconds)} of {streams * count} frames were answered")
    p99_s = float(np.quantile(seconds, 0.99))
    report.rows.append(
        {
            "name": f"{streams} streams of 640x360 i420 at once",
            "ours": asdict(Timing.of(seconds)),
            "frames_per_s": rate,
            "p99_s": p99_s,
        }
    )
    print(f"{streams} streams at once: {rate:.0f} frames/s, {Timing.of(seconds)}, p99 {p99_s * 1e3:.0f} ms", flush=True)


def _add(report: Report, name: str, pair: Any, peer_name: str) -> None:
    rates = {"frames_per_s": 1 / pair.ours.median_s, "peer_frames_per_s": 1 / pair.peer.median_s}
    report.add_pair(f"{name} / {peer_name}", pair, peer_name=peer_name, **rates)


def _drain(results: Iterator[unbend.StreamResult], count: int) -> None:
    corrected = sum(result.status is unbend.FrameStatus.CORRECTED for result in results)
    if corrected != count:
        raise RuntimeError(f"{corrected} of {count} frames were corrected")


def _echo(channel: grpc.Channel, arrays: list[np.ndarray[Any, Any]], count: int) -> None:
    """The same bytes there and back, IN_FLIGHT at a time, each copied out of its array as a client has to."""
    room = threading.Semaphore(IN_FLIGHT)

    def source() -> Iterator[bytes]:
        for n in range(count):
            room.acquire()
            yield arrays[n % DISTINCT].tobytes()

    call = channel.stream_stream(METHOD, request_serializer=None, response_deserializer=None)
    for _ in call(source()):
        room.release()


def _ffmpeg(folder: Path, grid: Grid, batch: list[Frame], count: int) -> list[str]:
    """The remap filter on the same frames and map, read from memory as raw video and thrown away."""
    x, y = BareRemap(Frame(PixelFormat.GRAY8, WIDTH, HEIGHT, batch[0].data[: WIDTH * HEIGHT]), grid).maps[0]
    for name, positions in (("x", x), ("y", y)):
        header = f"P5 {WIDTH} {HEIGHT} 65535\n".encode()
        (folder / f"{name}.pgm").write_bytes(header + np.rint(positions).clip(0, 65535).astype(">u2").tobytes())
    with (folder / "frames.yuv").open("wb") as file:
        for n in range(count):
            file.write(batch[n % DISTINCT].data.tobytes())
    raw = ["-f", "rawvideo", "-pix_fmt", "yuv420p", "-s", f"{WIDTH}x{HEIGHT}", "-i", str(folder / "frames.yuv")]
    maps = ["-i", str(folder / "x.pgm"), "-i", str(folder / "y.pgm")]
    # the filter takes one map for all planes, and therefore frames that are not subsampled: as users have to run it
    filters = "[0:v]format=yuv444p[v];[v][1:v][2:v]remap,format=yuv420p"
    return ["ffmpeg", "-loglevel", "error", *raw, *maps, "-lavfi", filters, "-f", "null", "-"]
