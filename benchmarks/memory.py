"""Memory of every process under a mixed load of streams, a fifth of them given up in the middle."""

from __future__ import annotations

import argparse
import http.client
import threading
import time
from collections import defaultdict
from random import Random

import numpy as np
import psutil

import unbend
from benchmarks.material import barrel_grid, frames, jpeg, photograph
from benchmarks.measurement import Report
from benchmarks.serving import Served, served
from unbend_service.domain.frames import PixelFormat

BAR_MIB_PER_MINUTE = 1.0
CANCELLED_SHARE = 0.2
LOADS = 4


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the suite."""
    parser.add_argument("--minutes", type=float, default=30.0, help="how long; the first fifth does not count")


def run(arguments: argparse.Namespace) -> Report:
    """The slope of the resident memory of parent and workers, in MiB a minute, over the time after warm-up.

    What is shared (files, the frames' slots, which a setting bounds) does not count.
    """
    report = Report("memory")
    minutes = 0.1 if arguments.quick else arguments.minutes
    resident: dict[int, list[tuple[float, float]]] = defaultdict(list)
    with served(renderer="cpu") as service:
        end = time.monotonic() + 60 * minutes
        loads = [threading.Thread(target=_load, args=(service, end, Random(seed))) for seed in range(LOADS)]
        for load in loads:
            load.start()
        parent = psutil.Process(service.pid)
        while time.monotonic() < end:
            time.sleep(min(2.0, 6 * minutes))
            for process in (parent, *parent.children(recursive=True)):
                memory = process.memory_info()
                resident[process.pid].append((time.monotonic(), (memory.rss - memory.shared) / 2**20))
        for load in loads:
            load.join()
    for pid, points in resident.items():
        kept = np.array(points[len(points) // 5 :])
        slope = float(np.polyfit((kept[:, 0] - kept[0, 0]) / 60, kept[:, 1], 1)[0]) if len(kept) > 2 else 0.0
        name = "parent" if pid == service.pid else f"worker {sorted(resident).index(pid)}"
        row = {"name": name, "first_mib": kept[0, 1], "last_mib": kept[-1, 1], "most_mib": kept[:, 1].max()}
        report.rows.append({**row, "mib_per_minute": slope, "minutes": minutes})
        print(f"{name}: {kept[0, 1]:.0f} to {kept[-1, 1]:.0f} MiB, {slope:+.2f} MiB a minute", flush=True)
        report.add_ratio(f"{name}: MiB a minute over {minutes:g} minutes", slope, at_most=BAR_MIB_PER_MINUTE)
    return report


def _load(service: Served, end: float, random: Random) -> None:
    """Streams and single pictures, one after the other."""
    batch = frames(PixelFormat.I420, 640, 360, 4)
    arrays = [frame.data.reshape(540, 640) for frame in batch]
    body = jpeg(photograph(1280, 720, random.randrange(1000)))
    with unbend.Client(service.grpc, timeout_s=60) as client:
        record = client.grids.put(unbend.Grid(barrel_grid().source))
        while time.monotonic() < end:
            give_up_at = random.randrange(1, 20) if random.random() < CANCELLED_SHARE else None
            with client.stream(640, 360, "i420", grid=record) as stream:
                for result in stream.correct(arrays[n % 4] for n in range(30)):
                    if result.index == give_up_at:
                        break
            connection = http.client.HTTPConnection(service.http)  # an idle one would be closed while streams run
            connection.request("POST", "/v1/correct", body + random.randbytes(8), {"content-type": "image/jpeg"})
            connection.getresponse().read()
            connection.close()
