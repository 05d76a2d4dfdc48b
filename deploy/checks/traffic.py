"""Traffic of every kind that the dashboard shows: what succeeds, what is left alone, what is refused, what fails."""

from __future__ import annotations

import http.client
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import psutil

import unbend
import unbend_service
from benchmarks.material import jpeg, photograph
from benchmarks.serving import Served

WIDTH, HEIGHT = 320, 240
#: A photograph that the service corrects; the page offers it for a try.
SAMPLE = Path(unbend_service.__file__).parent / "web/samples/shopfront.jpg"
#: The service under this traffic lets one stream in, so that a second one is refused.
SETTINGS = {"renderer": "cpu", "workers": 2, "streams": 1}


@contextmanager
def traffic(service: Served) -> Iterator[None]:
    """Keeps a service busy in other threads until the block ends, and kills a render worker now and then."""
    stop = threading.Event()
    works = (_pictures, _streams, _mischief)
    threads = [threading.Thread(target=_repeat, args=(work, service, stop)) for work in works]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        for thread in threads:
            thread.join()


def _repeat(work: Callable[[Served, int], None], service: Served, stop: threading.Event) -> None:
    turn = 0
    while not stop.is_set():
        work(service, turn)
        turn += 1
        stop.wait(0.2)


def _pictures(service: Served, turn: int) -> None:
    """A bent photograph that is known after the first time, one that is new, one left alone, one that is no picture."""
    bent = SAMPLE.read_bytes()
    flat = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    bodies = (bent, bent + turn.to_bytes(8), jpeg(flat), b"no picture")
    connection = http.client.HTTPConnection(service.http, timeout=30)
    for path in ("/v1/correct", "/v1/estimate"):
        for body in bodies:
            connection.request("POST", path, body, {"content-type": "image/jpeg"})
            connection.getresponse().read()
    connection.close()


def _streams(service: Served, turn: int) -> None:
    """A stream, and a second one beside it that has to be refused."""
    frames = [photograph(WIDTH, HEIGHT, seed) for seed in range(3)]
    with unbend.Client(service.grpc, timeout_s=30) as client:
        client.correct(frames[0])
        with client.stream(WIDTH, HEIGHT, "rgb24") as first:
            for result in first.correct(frames[n % 3] for n in range(12)):
                if result.index == 4:
                    _second_stream(service)
        with suppress(unbend.UnbendError):
            client.correct(frames[0], grid="0" * 32)


def _second_stream(service: Served) -> None:
    with (
        unbend.Client(service.grpc, timeout_s=5) as client,
        suppress(unbend.UnbendError),
        client.stream(WIDTH, HEIGHT, "rgb24") as stream,
    ):
        list(stream.correct(iter([photograph(WIDTH, HEIGHT, 1)])))


def _mischief(service: Served, turn: int) -> None:
    """Kills one render worker every five seconds, as a driver would that crashes."""
    time.sleep(5)
    workers = [child for child in psutil.Process(service.pid).children(recursive=True) if _renders(child)]
    if workers:
        with suppress(psutil.NoSuchProcess):
            workers[turn % len(workers)].send_signal(signal.SIGKILL)


def _renders(process: psutil.Process) -> bool:
    with suppress(psutil.Error):
        return any("renderers.worker" in word for word in process.cmdline())
    return False
