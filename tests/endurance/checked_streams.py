"""Streams of frames no two of which are alike; each answer is compared with the picture that it has to be."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import cv2
import numpy as np

import unbend
from benchmarks.material import frames, photograph
from unbend_service.adapters.renderers.cpu import CpuRenderer
from unbend_service.application.fitting import fitted
from unbend_service.domain.fit import CROP
from unbend_service.domain.frames import BLACK, Frame, PixelFormat
from unbend_service.domain.grid import Grid

#: Mean difference of two files of the same picture, in grey levels of 255; files of two frames differ by far more.
_JPEG_TOLERANCE = 4.0


@dataclass
class Tally:
    """What a stream saw.

    Attributes:
        answered_s: monotonic time of each answer.
        errors: what must not be: lost, duplicated, reordered or wrong.
    """

    sent: int = 0
    corrected: int = 0
    dropped: int = 0
    lost: int = 0
    reordered: int = 0
    wrong: int = 0
    answered_s: list[float] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)


class CheckedStream(threading.Thread):
    """One client with one stream, at ``rate`` frames a second until ``stop`` is set.

    Args:
        exact: whether pictures have to be equal sample by sample (the cpu renderer), or nearly.
    """

    def __init__(
        self,
        address: str,
        grid: Grid,
        pixel_format: str,
        size: tuple[int, int],
        *,
        rate: float,
        stop: threading.Event,
        seed: int,
        delivery: str = "lossless",
        exact: bool = True,
    ) -> None:
        super().__init__(name=f"stream-{seed}-{pixel_format}-{delivery}")
        self.tally = Tally()
        self._address = address
        self._grid = grid
        self._format = pixel_format
        self._width, self._height = size
        self._period_s = 1 / rate
        self._halt = stop
        self._seed = seed
        self._delivery = delivery
        self._exact = exact
        self._renderer = CpuRenderer()
        self._fitted = fitted(grid, CROP, 1.0)
        self._expected: dict[int, np.ndarray] = {}
        if pixel_format == "jpeg":
            self._base = [photograph(self._width, self._height, seed)]
        else:
            kind = PixelFormat(pixel_format)
            self._base = [frame.data for frame in frames(kind, self._width, self._height, 4)]

    def run(self) -> None:
        tally = self.tally
        try:
            with unbend.Client(self._address, timeout_s=60) as client:
                record = client.grids.put(unbend.Grid(self._grid.source))
                with client.stream(
                    self._width, self._height, self._format, grid=record, delivery=self._delivery, in_flight=6
                ) as stream:
                    for result in stream.correct(self._frames()):
                        self._check(result)
        except Exception as error:  # whatever it is, the frames that are not answered are lost
            tally.errors.append(repr(error))
        tally.lost += tally.sent - len(tally.answered_s)

    def _frames(self) -> Iterator[np.ndarray | bytes]:
        due_s = time.monotonic()
        while not self._halt.is_set():
            time.sleep(max(0.0, due_s - time.monotonic()))
            due_s = max(due_s + self._period_s, time.monotonic() - 1)
            number = self.tally.sent
            self.tally.sent += 1
            yield self._encoded(number) if self._format == "jpeg" else self._raw(number)

    def _raw(self, number: int) -> np.ndarray:
        data = self._base[number % len(self._base)].copy()
        name = np.frombuffer(hashlib.blake2b(f"{self._seed} {number}".encode()).digest(), np.uint8)
        middle = data.size // 3
        data[middle : middle + 64 * 100] = np.tile(name, 100)
        kind = PixelFormat(self._format)
        drawn = np.empty_like(data)
        self._renderer.render(Frame(kind, self._width, self._height, data), self._fitted, BLACK, drawn)
        self._expected[number] = drawn
        if kind in (PixelFormat.I420, PixelFormat.NV12):
            return data.reshape(-1, self._width)
        return data.reshape((self._height, self._width, -1) if kind is not PixelFormat.GRAY8 else (self._height, -1))

    def _encoded(self, number: int) -> bytes:
        picture = self._base[0].copy()
        for bit in range(10):  # the number of the frame as ten squares
            x = self._width // 4 + bit * self._width // 20
            level = 255 if number >> bit & 1 else 0
            picture[self._height // 3 : self._height // 2, x : x + self._width // 20] = level
        _, body = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
        pixels = cv2.imdecode(body, cv2.IMREAD_COLOR)[..., ::-1]
        drawn = np.empty(pixels.size, np.uint8)
        source = np.ascontiguousarray(pixels).reshape(-1)
        kind = PixelFormat.RGB24
        self._renderer.render(Frame(kind, self._width, self._height, source), self._fitted, BLACK, drawn)
        self._expected[number] = drawn
        return body.tobytes()

    def _check(self, result: unbend.StreamResult) -> None:
        tally = self.tally
        if result.index != len(tally.answered_s):
            tally.reordered += 1
            tally.errors.append(f"answer {result.index} came in place of {len(tally.answered_s)}")
        tally.answered_s.append(time.monotonic())
        expected = self._expected.pop(result.index, None)
        if str(result.status) == "dropped" and self._delivery == "latest":
            tally.dropped += 1
            return
        if str(result.status) != "corrected" or result.image is None or expected is None:
            tally.lost += 1
            tally.errors.append(f"frame {result.index}: {result.status} {result.error}")
            return
        tally.corrected += 1
        if not self._alike(result.image, expected):
            tally.wrong += 1
            tally.errors.append(f"frame {result.index} came back as another picture")

    def _alike(self, image: np.ndarray | bytes, expected: np.ndarray) -> bool:
        if isinstance(image, bytes):
            pixels = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].reshape(-1)
            return float(np.abs(pixels.astype(np.int16) - expected).mean()) < _JPEG_TOLERANCE
        drawn = np.asarray(image).reshape(-1)
        if self._exact:
            return bool((drawn == expected).all())
        return float(np.abs(drawn.astype(np.int16) - expected).mean()) < 1.0
