"""Cameras behind known lenses, each a stream in a thread of its own that keeps account of what it is answered."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt

import unbend

WIDTH, HEIGHT = 480, 360
_MARK_PX = 24

Picture = npt.NDArray[np.uint8]


def facade(bend: float) -> Picture:
    """(HEIGHT, WIDTH) uint8: rows of windows through a barrel lens (division model, frame of the half diagonal)."""
    drawn = np.full((960, 1280), 190, np.uint8)
    for x in range(60, 1200, 120):
        for y in range(60, 840, 160):
            cv2.rectangle(drawn, (x, y), (x + 70, y + 110), 50, -1)
            cv2.rectangle(drawn, (x + 6, y + 6), (x + 64, y + 104), 130, 3)
    straight = cv2.resize(drawn, (2 * WIDTH, 2 * HEIGHT), interpolation=cv2.INTER_AREA)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float64)
    dx, dy = (x - WIDTH / 2 + 0.5) / (WIDTH / 2), (y - HEIGHT / 2 + 0.5) / (WIDTH / 2)
    scale = 1 / (1 - bend * (dx**2 + dy**2) / (1 + (HEIGHT / WIDTH) ** 2))
    zoom = WIDTH * (1 - bend)
    map_x, map_y = (WIDTH + dx * scale * zoom).astype(np.float32), (HEIGHT + dy * scale * zoom).astype(np.float32)
    return np.asarray(cv2.remap(straight, map_x, map_y, cv2.INTER_AREA), np.uint8)


def numbered(scene: Picture, index: int) -> Picture:
    """The scene with a mark in its middle, where no lens moves it, that says which frame it is."""
    picture = scene.copy()
    y, x = HEIGHT // 2, WIDTH // 2
    picture[y - _MARK_PX : y + _MARK_PX, x - _MARK_PX : x + _MARK_PX] = _mark(index)
    cv2.circle(picture, (30 + 7 * index % (WIDTH - 60), HEIGHT - 40), 16, 230, -1)  # no two frames give one estimate
    return picture


def says(picture: Picture) -> int:
    """The mark of a corrected picture."""
    y, x = HEIGHT // 2, WIDTH // 2
    return round(float(picture[y - 4 : y + 4, x - 4 : x + 4].mean()))


def _mark(index: int) -> int:
    return 20 + index * 37 % 211


@dataclass
class Account:
    """What one camera saw of its stream.

    Attributes:
        frames: answered.
        wrong: answers that were not the next one, not corrected, or another frame's picture.
        grid_ids: every grid that the stream was said to have, in order.
        answered_at: monotonic time of each answer, in seconds.
        failure: what ended the stream, if something did.
    """

    frames: int = 0
    wrong: list[str] = field(default_factory=list)
    grid_ids: list[str] = field(default_factory=list)
    answered_at: list[float] = field(default_factory=list)
    failure: str = ""


class Camera(threading.Thread):
    """Sends frames until it is told to stop, or ``frames`` of them.

    Args:
        rate: frames a second; None: as fast as they are answered.
    """

    def __init__(
        self, target: str, stream_id: str, bend: float, *, rate: float | None = 10.0, frames: int | None = None
    ) -> None:
        super().__init__(name=stream_id, daemon=True)
        self._target = target
        self._scene = facade(bend)
        self._rate = rate
        self._frames = frames
        self._ending = threading.Event()
        self.stream_id = stream_id
        self.bend = bend
        self.account = Account()

    def end(self) -> None:
        """No further frame; the camera ends when the last one is answered."""
        self._ending.set()

    def run(self) -> None:
        try:
            self._converse()
        except Exception as error:
            self.account.failure = f"{type(error).__name__}: {error}"

    def _converse(self) -> None:
        account = self.account
        with (
            unbend.Client(self._target, timeout_s=60) as client,
            client.stream(
                WIDTH, HEIGHT, "gray8", stream_id=self.stream_id, min_confidence=0.0, reconnects=30
            ) as stream,
        ):
            for result in stream.correct(self._pictures()):
                account.answered_at.append(time.monotonic())
                if stream.grid is not None and account.grid_ids[-1:] != [stream.grid.grid_id]:
                    account.grid_ids.append(stream.grid.grid_id)
                self._check(result)
                account.frames += 1

    def _check(self, result: unbend.StreamResult) -> None:
        expected = self.account.frames
        if result.index != expected:
            self.account.wrong.append(f"frame {result.index} instead of {expected}")
        elif str(result.status) != "corrected" or not isinstance(result.image, np.ndarray):
            self.account.wrong.append(f"frame {expected} {result.status} {result.error}")
        elif abs(says(result.image) - _mark(expected)) > 2:
            self.account.wrong.append(f"frame {expected} has another frame's picture")

    def _pictures(self) -> Iterator[Picture]:
        start, index = time.monotonic(), 0
        while not self._ending.is_set() and (self._frames is None or index < self._frames):
            yield numbered(self._scene, index)
            index += 1
            if self._rate is not None:
                self._ending.wait(max(0.0, start + index / self._rate - time.monotonic()))


def all_beyond(cameras: list[Camera], more: int, within_s: float = 120.0) -> None:
    """Waits until every camera had ``more`` further answers. Raises RuntimeError after ``within_s`` seconds."""
    wanted = [camera.account.frames + more for camera in cameras]
    end = time.monotonic() + within_s
    while any(camera.account.frames < frames for camera, frames in zip(cameras, wanted, strict=True)):
        failed = [f"{camera.stream_id}: {camera.account.failure}" for camera in cameras if camera.account.failure]
        if failed or time.monotonic() > end:
            raise RuntimeError(f"streams stand still: {failed or 'no answers'}")
        time.sleep(0.05)
