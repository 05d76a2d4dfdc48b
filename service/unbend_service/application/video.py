"""Correct a whole video.

Decoding, rendering and encoding overlap, in order, with a bounded number of frames under way.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from unbend_service.application.blocking import BlockingWork
from unbend_service.application.estimation import ESTIMATE_LONGEST_PX, Estimation, fused_estimate
from unbend_service.application.grey import grey_of_frame
from unbend_service.domain.errors import InvalidFrame
from unbend_service.domain.frames import Bytes, Frame, PixelFormat, frame_size_bytes
from unbend_service.domain.records import Correct, GridRecord


@dataclass(frozen=True, slots=True)
class Picture:
    """A decoded picture of a video.

    Attributes:
        frame: i420.
        timing: the reader's and the writer's own; carried along.
    """

    frame: Frame
    timing: object = None


@dataclass(frozen=True, slots=True)
class Passenger:
    """A packet that is copied as it is: sound, subtitles, or a video that is left alone.

    Attributes:
        packet: the reader's and the writer's own.
        is_picture: whether it belongs to the video itself.
    """

    packet: object
    is_picture: bool = False


class VideoReader(Protocol):
    """A video that is read from its beginning to its end. Blocking; used by one thread at a time."""

    def read(self) -> Sequence[Picture | Passenger]:
        """What comes next, in the order of the file; empty at the end. Raises InvalidImage for a broken input."""
        ...


class VideoWriter(Protocol):
    """Where a video is written to. Blocking; used by one thread at a time."""

    def write_picture(self, picture: Picture) -> None: ...

    def write_passenger(self, passenger: Passenger) -> None: ...


#: Draws one frame; frames may be under way at once and finish in any order.
DrawFrame = Callable[[Frame], Awaitable[Bytes]]


@dataclass(slots=True)
class Progress:
    """How far a run is; ``stop`` ends it early, with everything that was read written."""

    frames: int = 0
    stop: bool = False


async def correct_video(
    reader: VideoReader,
    writer: VideoWriter,
    draw: DrawFrame,
    *,
    window: int,
    ahead: Sequence[Picture | Passenger] = (),
    preview: bool = False,
    progress: Progress | None = None,
) -> int:
    """Reads, draws and writes until the end, or until ``progress.stop``.

    Args:
        window: pictures that are under way at once, at least 1.
        ahead: what was read already.
        preview: whether original and result are written side by side.

    Returns:
        Pictures written.

    Raises:
        Whatever reader, writer and ``draw`` raise; what was drawn before is written then.
    """
    progress = progress or Progress()
    under_way: asyncio.Queue[tuple[Picture | Passenger, asyncio.Task[Bytes] | None] | None] = asyncio.Queue(window)

    async def take(items: Sequence[Picture | Passenger]) -> None:
        for item in items:
            task = asyncio.create_task(_drawn(draw, item.frame)) if isinstance(item, Picture) else None
            await under_way.put((item, task))

    async def produce() -> None:
        try:
            await take(ahead)
            while not progress.stop and (items := await asyncio.to_thread(reader.read)):
                await take(items)
        except asyncio.CancelledError:  # nobody takes anything from the queue any more
            raise
        except BaseException:
            await under_way.put(None)
            raise
        await under_way.put(None)

    async def consume() -> None:
        while (entry := await under_way.get()) is not None:
            item, task = entry
            if isinstance(item, Passenger) or task is None:
                if isinstance(item, Passenger):
                    await asyncio.to_thread(writer.write_passenger, item)
                continue
            drawn = replace(item.frame, data=await task)
            shown = side_by_side(item.frame, drawn) if preview else drawn
            await asyncio.to_thread(writer.write_picture, replace(item, frame=shown))
            progress.frames += 1

    producing, consuming = asyncio.create_task(produce()), asyncio.create_task(consume())
    try:
        done, _ = await asyncio.wait({producing, consuming}, return_when=asyncio.FIRST_EXCEPTION)
        for task in done:
            if producing is task and task.exception() is not None:
                await consuming  # what was read before the fault is still written
        for task in (consuming, producing):
            await task
    finally:
        for task in (producing, consuming):
            task.cancel()
        await asyncio.gather(producing, consuming, return_exceptions=True)
        while not under_way.empty():
            entry = under_way.get_nowait()
            if entry is not None and entry[1] is not None:
                entry[1].cancel()
    return progress.frames


async def copy_video(
    reader: VideoReader,
    writer: VideoWriter,
    *,
    ahead: Sequence[Passenger],
    progress: Progress,
) -> int:
    """Copies a video whose pictures stay as they are, packet by packet, until the end or ``progress.stop``.

    Returns:
        Pictures written.

    Raises:
        Whatever reader and writer raise.
    """

    def copy(items: Sequence[Picture | Passenger]) -> None:
        for item in items:
            if isinstance(item, Passenger):
                writer.write_passenger(item)
                progress.frames += item.is_picture

    await asyncio.to_thread(copy, ahead)
    while not progress.stop and (items := await asyncio.to_thread(reader.read)):
        await asyncio.to_thread(copy, items)
    return progress.frames


async def estimate_over(
    frames: Sequence[Frame],
    estimation: Estimation,
    blocking: BlockingWork,
    correct: Correct,
    min_confidence: float | None,
) -> GridRecord:
    """One grid for all frames of a video, from a few of them.

    Raises:
        InvalidFrame: no frame.
        QueueFull, InvalidOption.
    """
    if not frames:
        raise InvalidFrame("The video has no picture.")
    estimates = []
    for frame in frames:
        grey = await blocking.run("decode", grey_of_frame, frame, ESTIMATE_LONGEST_PX)
        estimates.append(await estimation.of_grey(grey))
    combined = await blocking.run("grid", fused_estimate, estimates)
    return await estimation.record(combined, correct, min_confidence)


def side_by_side(left: Frame, right: Frame) -> Frame:
    """Two i420 frames of one size as one of twice the width (for an odd width: one column less each)."""
    width = left.width // 2 * 2
    data = np.empty(frame_size_bytes(PixelFormat.I420, 2 * width, left.height), np.uint8)
    both = Frame(PixelFormat.I420, 2 * width, left.height, data)
    for out, first, second in zip(both.plane_arrays(), left.plane_arrays(), right.plane_arrays(), strict=True):
        half = out.shape[1] // 2
        out[:, :half], out[:, half:] = first[:, :half], second[:, :half]
    return both


async def _drawn(draw: DrawFrame, frame: Frame) -> Bytes:
    return await draw(frame)
