"""Shows that an installation outlives its parts: replicas that are killed or restarted, and Redis that hangs."""

from __future__ import annotations

import argparse
import statistics
import time

import numpy as np

import unbend
from benchmarks.cameras import Camera, all_beyond
from benchmarks.cluster import Cluster, Replica, running
from benchmarks.proxies import PROXIES

#: Strengths of the barrel lenses that cameras have; far enough apart that an estimate of one is nearest to its own.
LENSES = (0.06, 0.14, 0.22, 0.3)


class Verdict:
    """What was promised and whether it was kept; one line."""

    def __init__(self, step: str) -> None:
        self._step = step
        self._said: list[str] = []
        self.kept = True

    def expect(self, kept: bool, what: str) -> None:
        """Something that has to be so."""
        self._said.append(what if kept else f"{what} (BROKEN)")
        self.kept = self.kept and kept

    def say(self, what: str) -> None:
        """A figure without a bar."""
        self._said.append(what)

    def __str__(self) -> str:
        return f"{'PASS' if self.kept else 'FAIL'} {self._step}: {', '.join(self._said)}"


class Estimates:
    """Counts the estimates of all replicas, those that have ended included."""

    def __init__(self, cluster: Cluster) -> None:
        self._cluster = cluster
        self._ended = 0.0

    def before_the_end_of(self, replica: Replica) -> None:
        self._ended += replica.metric("unbend_estimates_total")

    def total(self) -> int:
        return round(self._ended + sum(replica.metric("unbend_estimates_total") for replica in self._cluster.replicas))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the demonstration."""
    parser.add_argument("step", choices=("all", *STEPS), nargs="?", default="all", help="what is to be outlived")
    parser.add_argument("--proxy", choices=tuple(PROXIES), default="haproxy", help="what stands before the replicas")
    parser.add_argument("--streams", type=int, default=8, help="streams at once")
    parser.add_argument("--rate", type=float, default=5.0, help="frames a second of each")
    parser.add_argument("--outage-s", type=float, default=20.0, help="how long Redis answers nothing")


def run(arguments: argparse.Namespace) -> int:
    """Runs the steps on two replicas; the last line is the verdict, and the exit status follows it."""
    verdicts = []
    with running(2, arguments.proxy) as cluster:
        for step in STEPS if arguments.step == "all" else [arguments.step]:
            verdicts.append(STEPS[step](cluster, arguments))
            print(verdicts[-1], flush=True)
    kept = sum(verdict.kept for verdict in verdicts)
    print(f"{'PASS' if kept == len(verdicts) else 'FAIL'} scale-demo: {kept} of {len(verdicts)} steps as promised")
    return 0 if kept == len(verdicts) else 1


def kill(cluster: Cluster, arguments: argparse.Namespace) -> Verdict:
    """One replica is killed with SIGKILL in the middle of its streams."""
    verdict, estimates = Verdict("kill -9"), Estimates(cluster)
    known = estimates.total()
    cameras = _rolling(cluster, arguments, "kill")
    victim = max(cluster.replicas, key=_streams)
    survivor = next(replica for replica in cluster.replicas if replica is not victim)
    moved = _streams(victim)
    estimates.before_the_end_of(victim)
    killed_at = time.monotonic()
    victim.kill()
    all_beyond(cameras, 20)
    verdict.expect(moved > 0, f"{moved} of {len(cameras)} streams were on the replica that was killed")
    verdict.expect(_streams(survivor) == len(cameras), f"{_streams(survivor)} go on on the other")
    gaps_s = sorted(_gap_s(camera, killed_at) for camera in cameras)[-moved:]
    _restart(cluster, victim)
    _finish(cameras, verdict)
    _expect_estimated_once(verdict, estimates.total() - known, cameras)
    verdict.say(f"failover {statistics.median(gaps_s):.2f} s (median), {max(gaps_s):.2f} s (longest)")
    return verdict


def rolling(cluster: Cluster, arguments: argparse.Namespace) -> Verdict:
    """Both replicas are restarted one after the other, with SIGTERM."""
    verdict, estimates = Verdict("rolling restart"), Estimates(cluster)
    known = estimates.total()
    cameras = _rolling(cluster, arguments, "rolling")
    gaps_s = []
    for replica in cluster.replicas:
        estimates.before_the_end_of(replica)
        stopped_at = time.monotonic()
        status = replica.drain()
        verdict.expect(status == 0, f"{replica.name} ended with {status} in {time.monotonic() - stopped_at:.1f} s")
        all_beyond(cameras, 10)
        gaps_s += [_gap_s(camera, stopped_at) for camera in cameras]
        _restart(cluster, replica)
    all_beyond(cameras, 10)
    _finish(cameras, verdict)
    _expect_estimated_once(verdict, estimates.total() - known, cameras)
    verdict.say(f"longest pause of a stream {max(gaps_s):.2f} s")
    return verdict


def outage(cluster: Cluster, arguments: argparse.Namespace) -> Verdict:
    """Redis answers nothing for a while, under streams that go on, streams that are new, and streams that come back."""
    verdict = Verdict(f"redis away for {arguments.outage_s:g} s")
    cameras = _rolling(cluster, arguments, "outage")
    bound = {camera.stream_id: camera.account.grid_ids[-1] for camera in cameras}
    before = [camera.account.frames for camera in cameras]
    visitors: list[Camera] = []
    paused_at = time.monotonic()
    cluster.redis.pause()
    while time.monotonic() - paused_at < arguments.outage_s:
        lens = LENSES[len(visitors) % len(LENSES)]
        visitor = Camera(cluster.grpc, f"visitor-{len(visitors)}", lens, rate=None, frames=8)
        visitors.append(visitor)
        visitor.start()
        visitor.join(60)
    down = [replica.metric("unbend_grid_store_up") for replica in cluster.replicas]
    local = sum(replica.metric("unbend_grid_store_operations_total", result="local") for replica in cluster.replicas)
    cluster.redis.resume()
    resumed_at = time.monotonic()
    while any(replica.metric("unbend_grid_store_up") != 1 for replica in cluster.replicas):
        if time.monotonic() - resumed_at > 30:
            break
        time.sleep(0.2)
    up = [replica.metric("unbend_grid_store_up") for replica in cluster.replicas]
    during = sum(camera.account.frames for camera in cameras) - sum(before)
    pauses_s = [_longest_pause_s(camera, paused_at, resumed_at) for camera in cameras]
    _finish([*cameras, *visitors], verdict)
    verdict.expect(during > 0, f"{during} frames during the outage")
    verdict.expect(min(down) == 0, f"unbend_grid_store_up {min(down):g} during, {min(up):g} after")
    verdict.expect(min(up) == 1 and local > 0, f"{local:g} operations answered by the replicas themselves")
    verdict.expect(
        all(camera.account.grid_ids == [bound[camera.stream_id]] for camera in cameras), "streams kept their grids"
    )
    wrong = _strangers(cluster, [*cameras, *visitors])
    verdict.expect(not wrong, f"wrong grids {len(wrong)} of {len(visitors)} new streams{''.join(wrong)}")
    verdict.say(f"longest pause of a running stream {max(pauses_s):.2f} s")
    return verdict


STEPS = {"kill": kill, "rolling": rolling, "outage": outage}


def _streams(replica: Replica) -> int:
    return round(replica.metric("unbend_streams_active"))


def _rolling(cluster: Cluster, arguments: argparse.Namespace, name: str) -> list[Camera]:
    """Cameras whose streams have their grids and are spread over the replicas."""
    lenses = [LENSES[i % len(LENSES)] for i in range(arguments.streams)]
    cameras = [Camera(cluster.grpc, f"{name}-{i}", lens, rate=arguments.rate) for i, lens in enumerate(lenses)]
    for camera in cameras:
        camera.start()
    all_beyond(cameras, 15)
    return cameras


def _restart(cluster: Cluster, replica: Replica) -> None:
    replica.start()
    replica.wait_ready()
    cluster.wait_routed(len(cluster.replicas))


def _finish(cameras: list[Camera], verdict: Verdict) -> None:
    """Ends the streams and judges what each was answered: every frame once, in order, with its own picture."""
    for camera in cameras:
        camera.end()
    for camera in cameras:
        camera.join(60)
    accounts = [camera.account for camera in cameras]
    failed = [f"{camera.stream_id}: {camera.account.failure}" for camera in cameras if camera.account.failure]
    unfinished = [camera.stream_id for camera in cameras if camera.is_alive()]
    wrong = [each for account in accounts for each in account.wrong]
    verdict.expect(not failed and not unfinished, f"streams failed {len(failed) + len(unfinished)}{failed or ''}")
    frames = sum(account.frames for account in accounts)
    verdict.expect(not wrong, f"frames lost, repeated, failed or exchanged {len(wrong)} of {frames}{wrong[:3] or ''}")


def _expect_estimated_once(verdict: Verdict, estimates: int, cameras: list[Camera]) -> None:
    same = sum(len(camera.account.grid_ids) == 1 for camera in cameras)
    verdict.expect(same == len(cameras), f"{same} of {len(cameras)} with the same grid throughout")
    verdict.expect(estimates == len(cameras), f"estimates {estimates}, repeated {estimates - len(cameras)}")


def _gap_s(camera: Camera, since: float) -> float:
    """The longest time without an answer after ``since``, counted from the last answer before it."""
    before = [at for at in camera.account.answered_at if at <= since][-1:]
    after = [at for at in camera.account.answered_at if at > since]
    return float(max(np.diff([*before, *after]), default=float("inf")))


def _longest_pause_s(camera: Camera, start: float, end: float) -> float:
    answered = [at for at in camera.account.answered_at if start - 1 <= at <= end + 1]
    return float(max(np.diff(answered), default=float("inf")))


def _strangers(cluster: Cluster, cameras: list[Camera]) -> list[str]:
    """Streams with a grid that is nearer to another lens than to their own, as the shared store has it by now."""
    with unbend.Client(cluster.grpc, timeout_s=60) as client:
        lattices = {}
        for grid_id in {grid_id for camera in cameras for grid_id in camera.account.grid_ids}:
            grid = client.grids.get(grid_id).grid
            assert grid is not None
            lattices[grid_id] = grid.source
    regular = {camera.bend: lattices[camera.account.grid_ids[0]] for camera in reversed(cameras[: len(LENSES)])}
    strangers = []
    for camera in cameras:
        for grid_id in camera.account.grid_ids:
            far = {bend: float(np.abs(lattices[grid_id] - one).mean()) for bend, one in regular.items()}
            if min(far, key=lambda bend: far[bend]) != camera.bend:
                strangers.append(f" {camera.stream_id}")
    return strangers
