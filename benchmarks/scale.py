"""Cost against the size of frames and against the number of grids in use."""

from __future__ import annotations

import argparse
import itertools
from dataclasses import asdict

import numpy as np
import psutil

from benchmarks.material import barrel_grid, frames
from benchmarks.measurement import Report, Timing
from benchmarks.render import Pool
from unbend_service.domain.frames import PixelFormat

SIZES = ((256, 256), (640, 360), (1280, 720), (1920, 1080), (3840, 2160), (7680, 4320))
GRIDS = (10, 100, 1_000, 10_000)
#: A frame of twice the pixels may cost so much more than twice the time.
BAR_LINEAR = 1.5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the suite."""
    parser.add_argument("--runs", type=int, default=9, help="frames of each size")


def run(arguments: argparse.Namespace) -> Report:
    """Frames of i420 through a pool of the cpu renderer, one at a time; the peer of each size is the size before."""
    report = Report("scale")
    pool = Pool("cpu", 1)
    try:
        _sizes(report, pool, SIZES[:2] if arguments.quick else SIZES, 3 if arguments.quick else arguments.runs)
        for count in (10,) if arguments.quick else GRIDS:
            _grids(report, pool, count)
    finally:
        pool.close()
    return report


def _sizes(report: Report, pool: Pool, sizes: tuple[tuple[int, int], ...], runs: int) -> None:
    grid = barrel_grid()
    per_pixel: dict[tuple[int, int], float] = {}
    for width, height in sizes:
        batch = itertools.cycle(frames(PixelFormat.I420, width, height, 2))
        seconds = []
        for turn in range(runs + 2):
            taken_s = pool.one(next(batch), grid)
            if turn >= 2:
                seconds.append(taken_s)
        timing = Timing.of(seconds)
        per_pixel[width, height] = timing.median_s / (width * height)
        per_megapixel_ms = per_pixel[width, height] * 1e9
        report.rows.append(
            {"name": f"i420 {width}x{height}", "ours": asdict(timing), "ms_per_megapixel": per_megapixel_ms}
        )
        print(f"i420 {width}x{height}: {timing}, {per_megapixel_ms:.2f} ms a megapixel", flush=True)
    if (1920, 1080) in per_pixel:
        for size in ((3840, 2160), (7680, 4320)):
            share = per_pixel[size] / per_pixel[1920, 1080]
            report.add_ratio(f"time a pixel, {size[0]}x{size[1]} / 1920x1080", share, at_most=BAR_LINEAR)


def _grids(report: Report, pool: Pool, count: int) -> None:
    """640 x 360 frames, each through one of ``count`` grids at random."""
    random = np.random.default_rng(1)
    batch = frames(PixelFormat.I420, 640, 360, 4)
    grids = [barrel_grid(strength) for strength in np.linspace(0.05, 0.3, count)]
    for grid in grids[: min(count, 200)]:
        pool.one(batch[0], grid)
    numbers = random.integers(0, count, 200)
    seconds = [pool.one(batch[number % len(batch)], grids[number]) for number in numbers]
    workers = psutil.Process().children()
    rss_mib = sum(worker.memory_info().rss for worker in workers) / 2**20
    timing, p99_s = Timing.of(seconds), float(np.quantile(seconds, 0.99))
    report.rows.append(
        {"name": f"{count} grids in use", "ours": asdict(timing), "p99_s": p99_s, "worker_rss_mib": rss_mib}
    )
    print(f"{count} grids: {timing}, p99 {p99_s * 1e3:.1f} ms, worker {rss_mib:.0f} MiB", flush=True)
