"""What ``unbend video`` does with the options it was given."""

from __future__ import annotations

import asyncio
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from unbend_service.adapters.video.encoders import VideoCodec, default_codec
from unbend_service.adapters.video.reading import STANDARD_INPUT, PyavReader
from unbend_service.adapters.video.writing import PyavWriter
from unbend_service.adapters.video.y4m import Y4mWriter
from unbend_service.application.correction import CorrectOptions, leaves_alone
from unbend_service.application.video import Passenger, Picture, Progress, copy_video, correct_video
from unbend_service.cli.server import Server
from unbend_service.cli.video_backends import Prepared, PrivateBackend, ServerBackend, opened_backend
from unbend_service.cli.video_progress import shown
from unbend_service.domain.frames import Frame
from unbend_service.domain.records import GridRecord
from unbend_service.settings import Settings

_FULL_RANGE = 2


@dataclass(frozen=True, slots=True)
class Wish:
    """What the command line asks for."""

    source: str
    target: str
    codec: VideoCodec | None
    crf: int | None
    preset: str | None
    preview: bool
    samples: int
    server: Server | None
    grid: GridRecord | None
    options: CorrectOptions
    quiet: bool


@dataclass(frozen=True, slots=True)
class Result:
    """What became of it.

    Attributes:
        copied: whether the video itself was left as it is, packet by packet.
    """

    record: GridRecord
    frames: int
    seconds: float
    copied: bool
    interrupted: bool
    notes: list[str]


async def run(settings: Settings, wish: Wish) -> Result:
    """Reads, estimates, draws and writes. Raises what the reader, the writer and the backend raise."""
    progress = Progress()
    _stop_on_signals(progress)
    reader = PyavReader(wish.source)
    with closing(reader):
        writer = _writer(wish, reader)
        async with opened_backend(settings, wish.server) as backend:
            ahead, prepared = await _prepared(backend, reader, wish)
            start = time.perf_counter()
            with closing(writer), shown(progress, reader.frames_expected, wish.quiet):
                copied = _wants_copy(wish, reader, prepared.record) and writer.copy_video()
                kept = reader.settle(copy=copied)
                if copied:
                    frames = await copy_video(reader, writer, ahead=kept, progress=progress)
                else:
                    frames = await correct_video(
                        reader,
                        writer,
                        prepared.draw,
                        window=prepared.window,
                        ahead=ahead,
                        preview=wish.preview,
                        progress=progress,
                    )
            seconds = time.perf_counter() - start
    return Result(prepared.record, frames, seconds, copied, progress.stop, [*reader.notes, *writer.notes])


def _wants_copy(wish: Wish, reader: PyavReader, record: GridRecord) -> bool:
    """A video that is left alone loses nothing, unless its pictures are wanted in another form."""
    same_codec = wish.codec is None or wish.codec.value == reader.codec
    return leaves_alone(record) and not wish.preview and same_codec and wish.crf is None and wish.preset is None


async def _prepared(
    backend: PrivateBackend | ServerBackend, reader: PyavReader, wish: Wish
) -> tuple[list[Picture | Passenger], Prepared]:
    """The grid, and what had to be read of the input for it: of a file nothing, of a pipe its first frames.

    With a grid given one picture is looked at too: it says how the video is to be turned.
    """
    wanted = wish.samples if wish.grid is None else 1
    ahead: list[Picture | Passenger] = []
    samples: Sequence[Frame] = await asyncio.to_thread(reader.samples, wanted)
    if not samples:
        ahead = await asyncio.to_thread(reader.read_ahead, wanted)
        samples = [item.frame for item in ahead if isinstance(item, Picture)][:wanted]
    upright = [reader.as_shown(frame) for frame in samples]
    return ahead, await backend.prepare(upright, wish.grid, wish.options, reader.orientation)


def _writer(wish: Wish, reader: PyavReader) -> PyavWriter | Y4mWriter:
    if wish.target == STANDARD_INPUT:
        context = reader.stream.codec_context
        full_range = context.color_range == _FULL_RANGE
        return Y4mWriter(sys.stdout.buffer, reader.rate, full_range=full_range, aspect=context.sample_aspect_ratio)
    path = Path(wish.target)
    return PyavWriter(path, reader, wish.codec or default_codec(path.suffix), wish.crf, wish.preset)


def _stop_on_signals(progress: Progress) -> None:
    """The first Ctrl-C or SIGTERM ends the video where it is; the second ends the command."""
    loop = asyncio.get_running_loop()

    def stop(number: signal.Signals) -> None:
        progress.stop = True
        loop.remove_signal_handler(number)

    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop, number)
