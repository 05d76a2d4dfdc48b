"""Replicas behind HAProxy: what a frame costs, how the load spreads, how long a stream pauses when one is killed."""

from __future__ import annotations

import argparse
import statistics
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import psutil

import unbend
from benchmarks.cameras import Camera, all_beyond
from benchmarks.cluster import Cluster, running
from benchmarks.material import barrel_grid, frames, jpeg, photograph
from benchmarks.measurement import Report, Timing, by_turns
from benchmarks.proxies import HaProxy
from unbend_service.domain.frames import PixelFormat

STREAMS = 4
#: A proxy and a second replica on the same cores may cost so much of the frames a second.
BAR_PROXY, BAR_SPREAD = 0.8, 0.8
BAR_FAILOVER_S = 5.0


@dataclass(frozen=True, slots=True)
class Load:
    """Frames of one kind; ``pictures`` are sent in turn."""

    name: str
    width: int
    height: int
    pixel_format: str
    pictures: list[bytes]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the suite."""
    parser.add_argument("--runs", type=int, default=5, help="turns a case")
    parser.add_argument("--frames", type=int, default=48, help="frames a turn, over all streams")
    parser.add_argument("--kills", type=int, default=3, help="replicas killed")


def run(arguments: argparse.Namespace) -> Report:
    """Streams with a known grid, all at once, measured at the clients; replicas share the cores with all else."""
    report = Report("replicas")
    runs, count, kills = (2, 8, 1) if arguments.quick else (arguments.runs, arguments.frames, arguments.kills)
    sizes = (1, 2) if arguments.quick else (1, 2, 4)
    with running(max(sizes)) as cluster, tempfile.TemporaryDirectory() as folder:
        members = [(replica.grpc_port, replica.http_port) for replica in cluster.replicas]
        proxies = {size: HaProxy(Path(folder), members[:size]) for size in sizes}
        try:
            _await(lambda: all(proxy.healthy() == size for size, proxy in proxies.items()))
            for load in _loads(quick=arguments.quick):
                _throughput(report, cluster, proxies, load, runs, count)
        finally:
            for proxy in proxies.values():
                proxy.stop()
        _estimates(report, cluster, 4 if arguments.quick else 24)
        _failover(report, cluster, kills)
    return report


def _loads(*, quick: bool) -> Iterator[Load]:
    width, height = (320, 240) if quick else (1280, 720)
    files = [jpeg(photograph(width, height, seed)) for seed in range(2 if quick else 4)]
    yield Load(f"jpeg {width}x{height}", width, height, "jpeg", files)
    if not quick:
        raw = [frame.data.tobytes() for frame in frames(PixelFormat.I420, width, height, 4)]
        yield Load(f"i420 {width}x{height}", width, height, "i420", raw)


def _throughput(
    report: Report, cluster: Cluster, proxies: dict[int, HaProxy], load: Load, runs: int, count: int
) -> None:
    single = f"127.0.0.1:{cluster.replicas[0].grpc_port}"
    with unbend.Client(single) as client:
        grid_id = client.grids.put(unbend.Grid(barrel_grid().source)).grid_id
    targets = {size: f"127.0.0.1:{proxy.grpc_port}" for size, proxy in proxies.items()}

    def through(target: str) -> Callable[[], None]:
        return lambda: _stream(target, load, grid_id, count)

    pair = by_turns(through(targets[1]), through(single), runs, warm_up=1).per(count)
    report.add_pair(f"{load.name}, 1 replica behind HAProxy / without", pair)
    report.add_ratio(f"frames/s, {load.name}: behind HAProxy / without", 1 / pair.ratio, at_least=BAR_PROXY)
    for size in sorted(targets)[1:]:
        pair = by_turns(through(targets[size]), through(targets[1]), runs, warm_up=1).per(count)
        report.add_pair(f"{load.name}, {size} replicas on the same cores / 1", pair)
        report.add_ratio(f"frames/s, {load.name}: {size} replicas / 1, same cores", 1 / pair.ratio, at_least=BAR_SPREAD)
    proxy = psutil.Process(proxies[1].pid)
    costs = []
    for _ in range(runs):
        before = cluster.replicas[0].cpu_s(), _cpu_s(proxy)
        _stream(targets[1], load, grid_id, count)
        costs.append((cluster.replicas[0].cpu_s() - before[0], _cpu_s(proxy) - before[1]))
    service_s, proxy_s = (statistics.median(cost[i] / count for cost in costs) for i in (0, 1))
    sent = statistics.mean(len(picture) for picture in load.pictures)
    report.rows.append(
        {
            "name": f"{load.name}: processor time a frame",
            "service_cpu_ms": service_s * 1e3,
            "haproxy_cpu_ms": proxy_s * 1e3,
            "kib_in": sent / 1024,
        }
    )
    print(f"{load.name}: {service_s * 1e3:.1f} ms of processor a frame, HAProxy {proxy_s * 1e3:.2f} ms", flush=True)


def _stream(target: str, load: Load, grid_id: str, count: int) -> None:
    """``count`` frames over STREAMS streams at once."""
    each = max(1, count // STREAMS)
    failures: list[BaseException] = []

    def converse() -> None:
        try:
            with (
                unbend.Client(target, timeout_s=120) as client,
                client.stream(load.width, load.height, load.pixel_format, grid=grid_id) as stream,
            ):
                pictures = (load.pictures[n % len(load.pictures)] for n in range(each))
                answered = [str(result.status) for result in stream.correct(pictures)]
                if answered != ["corrected"] * each:
                    raise RuntimeError(f"frames were not corrected: {answered}")
        except BaseException as error:
            failures.append(error)

    threads = [threading.Thread(target=converse) for _ in range(STREAMS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if failures:
        raise failures[0]


def _estimates(report: Report, cluster: Cluster, count: int) -> None:
    """Processor time of one estimate and its decision, 720p JPEG."""
    replica = cluster.replicas[0]
    bodies = [jpeg(photograph(1280, 720, 100 + n)) for n in range(count)]
    with unbend.Client(f"127.0.0.1:{replica.grpc_port}", timeout_s=60) as client:
        client.estimate(bodies[0], min_confidence=0.0)
        before = replica.cpu_s()
        for body in bodies[1:]:
            client.estimate(body, min_confidence=0.0)
    cost_ms = (replica.cpu_s() - before) / (count - 1) * 1e3
    report.rows.append({"name": "an estimate, jpeg 1280x720: processor time", "service_cpu_ms": cost_ms})
    print(f"an estimate: {cost_ms:.0f} ms of processor", flush=True)


def _failover(report: Report, cluster: Cluster, kills: int) -> None:
    """From SIGKILL to the next answer, over the streams of the replica that was killed."""
    pauses_s: list[float] = []
    cameras = [Camera(cluster.grpc, f"camera-{n}", 0.2, rate=4.0) for n in range(8)]
    for camera in cameras:
        camera.start()
    all_beyond(cameras, 12)
    for _ in range(kills):
        victim = max(cluster.replicas, key=lambda replica: replica.metric("unbend_streams_active"))
        moved = round(victim.metric("unbend_streams_active"))
        killed_at = time.monotonic()
        victim.kill()
        all_beyond(cameras, 12)
        next_s = sorted(min(at for at in camera.account.answered_at if at > killed_at + 0.05) for camera in cameras)
        pauses_s += [at - killed_at for at in next_s[-moved:]]
        victim.start()
        victim.wait_ready()
        cluster.wait_routed(len(cluster.replicas))
    for camera in cameras:
        camera.end()
    for camera in cameras:
        camera.join(60)
    wrong = [each for camera in cameras for each in (*camera.account.wrong, camera.account.failure) if each]
    if wrong:
        raise RuntimeError(f"streams were not resumed as promised: {wrong[:3]}")
    timing = Timing.of(pauses_s)
    report.rows.append({"name": "failover of a stream, SIGKILL to next answer", "ours": asdict(timing)})
    report.add_ratio("failover, seconds, longest", max(pauses_s), at_most=BAR_FAILOVER_S)


def _cpu_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


def _await(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 30
    while not condition():
        if time.monotonic() > end:
            raise RuntimeError("HAProxy does not see its replicas")
        time.sleep(0.1)
