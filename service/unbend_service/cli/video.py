"""``unbend video``."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Annotated, Any

import typer

from unbend_service.adapters.video.encoders import VideoCodec
from unbend_service.application.correction import CorrectOptions
from unbend_service.cli.grid_source import load_record
from unbend_service.cli.reporting import decision, errors, errors_reported, fail, print_json
from unbend_service.cli.serve import read_settings
from unbend_service.cli.server import Server, reaches_server
from unbend_service.cli.video_run import Result, Wish, run
from unbend_service.domain.errors import InvalidOption
from unbend_service.domain.fit import Fit, check_strength
from unbend_service.domain.records import Correct

EXIT_INTERRUPTED = 130


@reaches_server
def video(
    source: Annotated[str, typer.Argument(metavar="IN", help="A file, a URL (rtsp, http), or - for y4m from a pipe.")],
    target: Annotated[str, typer.Argument(metavar="OUT", help="A file, its suffix says of which kind, or - for y4m.")],
    what: Annotated[str, typer.Option("--correct", help="nonlinear or all.")] = "nonlinear",
    fit: Annotated[str, typer.Option(help="keep, crop, full, or a number 0..1 between crop and full.")] = "crop",
    strength: Annotated[float, typer.Option(help="0..1, blend with the original.")] = 1.0,
    min_confidence: Annotated[
        float | None,
        typer.Option(min=0, max=1, help="Leave the video alone below this confidence, else correct all the way."),
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
    server: Server | None = None,
    model: Annotated[str | None, typer.Option(help="Name of a shipped model, or a path.")] = None,
    workers: Annotated[int, typer.Option(min=0, help="Render workers; 0: one a core.")] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace OUT if it is there.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print a summary as JSON.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar.")] = False,
) -> None:
    """Straighten a video: one grid for all of it; sound, subtitles, time and colours stay as they are.

    A video that is left alone is copied as it is, unless a codec, quality or preview is asked for.
    """
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
        wish = Wish(
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
        result = asyncio.run(run(read_settings(**chosen), wish))
    _report(result, wish, as_json)
    if result.interrupted:
        raise typer.Exit(EXIT_INTERRUPTED)


def _report(result: Result, wish: Wish, as_json: bool) -> None:
    record = result.record
    fps = result.frames / max(result.seconds, 1e-9)
    if as_json:
        summary = {key: value for key, value in record.provenance().items() if key != "guides"}
        counted = {"out": wish.target, "frames": result.frames, "seconds": result.seconds, "fps": fps}
        how = {"copied": result.copied, "interrupted": result.interrupted, "notes": result.notes}
        print_json({**summary, **counted, **how})
        return
    for note in result.notes:
        errors.print("note:", note, style="yellow", markup=False, highlight=False, soft_wrap=True)
    ended = (", copied without encoding it again" if result.copied else "") + (
        ", interrupted" if result.interrupted else ""
    )
    errors.print(
        f"{wish.target}: {result.frames} frames at {fps:.1f} a second, {decision(record)}, grid {record.id}{ended}",
        markup=False,
        highlight=False,
        soft_wrap=True,
    )
