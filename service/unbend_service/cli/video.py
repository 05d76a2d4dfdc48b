"""``unbend video``."""

from __future__ import annotations

import asyncio
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from rich import progress as bars

from unbend_service.adapters.video.encoders import VideoCodec, default_codec
from unbend_service.adapters.video.reading import STANDARD_INPUT, PyavReader
from unbend_service.adapters.video.writing import PyavWriter
from unbend_service.adapters.video.y4m import Y4mWriter
from unbend_service.application.correction import CorrectOptions
from unbend_service.application.video import Passenger, Picture, Progress, correct_video
from unbend_service.cli.grid_source import load_record
from unbend_service.cli.reporting import errors, errors_reported, fail, print_json
from unbend_service.cli.serve import read_settings
from unbend_service.cli.video_backends import Prepared, PrivateBackend, ServerBackend, opened_backend
from unbend_service.domain.errors import InvalidOption
from unbend_service.domain.fit import Fit, check_strength
from unbend_service.domain.frames import Frame
from unbend_service.domain.records import Correct, GridRecord
from unbend_service.settings import Settings

EXIT_INTERRUPTED = 130
_FULL_RANGE = 2


@dataclass(frozen=True, slots=True)
class _Wish:
    """What the command line asks for."""

    source: str
    target: str
    codec: VideoCodec | None
    crf: int | None
    preset: str | None
    preview: bool
    samples: int
    server: str | None
    grid: GridRecord | None
    options: CorrectOptions
    quiet: bool


@dataclass(frozen=True, slots=True)
class _Result:
    record: GridRecord
    frames: int
    seconds: float
    interrupted: bool
    notes: list[str]


def video(
    source: Annotated[str, typer.Argument(metavar="IN", help="A file, a URL (rtsp, http), or - for y4m from a pipe.")],
    target: Annotated[str, typer.Argument(metavar="OUT", help="A file, its suffix says of which kind, or - for y4m.")],
    what: Annotated[str, typer.Option("--correct", help="nonlinear or all.")] = "nonlinear",
    fit: Annotated[str, typer.Option(help="keep, crop, full, or a number 0..1 between crop and full.")] = "crop",
    strength: Annotated[float, typer.Option(help="0..1, blend with the original.")] = 1.0,
    min_confidence: Annotated[
        float | None, typer.Option(min=0, max=1, help="Leave the video alone below this confidence.")
    ] = None,
    grid: Annotated[str | None, typer.Option(help="A JSON file or an id: that grid instead of an estimate.")] = None,
    estimate_frames: Annotated[
        int, typer.Option(min=1, max=64, help="Frames that the grid is estimated over, spread over a file.")
    ] = 5,
    codec: Annotated[VideoCodec | None, typer.Option(help="h264 unless OUT is .webm [default: by OUT].")] = None,
    crf: Annotated[
        int | None, typer.Option(min=0, max=63, help="Quality, lower is better [h264 18, hevc 20, vp9 30, av1 28].")
    ] = None,
    preset: Annotated[str | None, typer.Option(help="Speed, in the encoder's words [medium, medium, 4, 8].")] = None,
    preview: Annotated[bool, typer.Option("--preview", help="Write original and result side by side.")] = False,
    server: Annotated[str | None, typer.Option(metavar="HOST:PORT", help="gRPC address of a running server.")] = None,
    model: Annotated[str | None, typer.Option(help="Name of a shipped model, or a path.")] = None,
    workers: Annotated[int, typer.Option(min=0, help="Render workers; 0: one a core.")] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace OUT if it is there.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print a summary as JSON.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar.")] = False,
) -> None:
    """Straighten a video: one grid for all of it; sound, subtitles, time and colours stay as they are."""
    with errors_reported():
        if target == "-" and as_json:
            raise InvalidOption("Standard output holds the video.", allowed="--json with a file as OUT")
        if target != "-" and Path(target).exists() and not overwrite:
            fail(f"{target} is there already; --overwrite replaces it", 2)
        if (
            target != "-"
            and source != "-"
            and Path(source).exists()
            and Path(target).resolve() == Path(source).resolve()
        ):
            raise InvalidOption("IN and OUT are the same file.", allowed="another OUT")
        chosen: dict[str, Any] = {"workers": workers} | ({} if model is None else {"model": model})
        wish = _Wish(
            source,
            target,
            codec,
            crf,
            preset,
            preview,
            estimate_frames,
            server,
            None if grid is None else load_record(grid, server),
            CorrectOptions(
                correct=Correct.parse(what),
                fit=Fit.parse(fit),
                strength=check_strength(strength),
                min_confidence=min_confidence,
            ),
            quiet,
        )
        result = asyncio.run(_run(read_settings(**chosen), wish))
    _report(result, wish, as_json)
    if result.interrupted:
        raise typer.Exit(EXIT_INTERRUPTED)


async def _run(settings: Settings, wish: _Wish) -> _Result:
    progress = Progress()
    _stop_on_signals(progress)
    reader = PyavReader(wish.source)
    with closing(reader):
        writer = _writer(wish, reader)
        async with opened_backend(settings, wish.server) as backend:
            ahead, prepared = await _prepared(backend, reader, wish)
            start = time.perf_counter()
            with closing(writer), _shown(progress, reader.frames_expected, wish.quiet):
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
    return _Result(prepared.record, frames, seconds, progress.stop, [*reader.notes, *writer.notes])


async def _prepared(
    backend: PrivateBackend | ServerBackend, reader: PyavReader, wish: _Wish
) -> tuple[list[Picture | Passenger], Prepared]:
    """The grid, and what had to be read of the input for it: of a file nothing, of a pipe its first frames."""
    ahead: list[Picture | Passenger] = []
    samples: Sequence[Frame] = []
    if wish.grid is None:
        samples = await asyncio.to_thread(reader.samples, wish.samples)
    if wish.grid is None and not samples:
        while sum(isinstance(item, Picture) for item in ahead) < wish.samples:
            items = await asyncio.to_thread(reader.read)
            if not items:
                break
            ahead += items
        samples = [item.frame for item in ahead if isinstance(item, Picture)][: wish.samples]
    return ahead, await backend.prepare(samples, wish.grid, wish.options)


def _writer(wish: _Wish, reader: PyavReader) -> PyavWriter | Y4mWriter:
    if wish.target == STANDARD_INPUT:
        full_range = reader.stream.codec_context.color_range == _FULL_RANGE
        return Y4mWriter(sys.stdout.buffer, reader.rate, full_range=full_range)
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


@contextmanager
def _shown(progress: Progress, expected: int | None, quiet: bool) -> Iterator[None]:
    """A bar on standard error with frames a second and the time left; nothing where that is no terminal."""
    if quiet or not errors.is_terminal:
        yield
        return
    columns = (
        bars.TextColumn("{task.completed}" + ("" if expected is None else "/{task.total}") + " frames"),
        bars.BarColumn(),
        _Rate(),
        bars.TimeRemainingColumn(),
    )
    with bars.Progress(*columns, console=errors, transient=True) as display:
        display.add_task("video", total=expected)
        _Follower.follow(display, progress)
        yield


class _Rate(bars.ProgressColumn):
    def render(self, task: bars.Task) -> str:
        return f"{task.finished_speed or task.speed or 0:.1f} fps"


class _Follower:
    """Copies the number of frames to the bar while the loop runs."""

    @staticmethod
    def follow(display: bars.Progress, progress: Progress) -> None:
        loop = asyncio.get_running_loop()

        def look() -> None:
            display.update(display.task_ids[0], completed=progress.frames)
            if display.live.is_started:
                loop.call_later(0.2, look)

        look()


def _report(result: _Result, wish: _Wish, as_json: bool) -> None:
    record = result.record
    fps = result.frames / max(result.seconds, 1e-9)
    if as_json:
        summary = {key: value for key, value in record.to_dict().items() if key not in ("grid", "guides")}
        counted = {"out": wish.target, "frames": result.frames, "seconds": result.seconds, "fps": fps}
        print_json({**summary, **counted, "interrupted": result.interrupted, "notes": result.notes})
        return
    for note in result.notes:
        errors.print("note:", note, style="yellow", markup=False, highlight=False, soft_wrap=True)
    reason = f" ({record.reason.value.replace('_', ' ')})" if record.reason else ""
    outcome = record.outcome.value.replace("_", " ")
    ended = ", interrupted" if result.interrupted else ""
    errors.print(
        f"{wish.target}: {result.frames} frames at {fps:.1f} a second, {outcome}{reason}, grid {record.id}{ended}",
        markup=False,
        highlight=False,
        soft_wrap=True,
    )
