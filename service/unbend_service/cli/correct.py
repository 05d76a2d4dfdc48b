"""``unbend correct``."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Annotated, Any

import typer

from unbend_service.application.correction import CorrectedImage, CorrectOptions
from unbend_service.cli.batch_run import correct_jobs, report_batch
from unbend_service.cli.batches import find_jobs, is_batch
from unbend_service.cli.private import private_service
from unbend_service.cli.reporting import console, decision, errors_reported, fail, print_json
from unbend_service.cli.serve import read_settings
from unbend_service.domain.errors import InvalidOption
from unbend_service.domain.fit import Fit, check_strength
from unbend_service.domain.records import Correct
from unbend_service.settings import Settings

_FORMATS = {".jpg": "jpeg", ".jpeg": "jpeg", ".png": "png", ".webp": "webp"}


def correct(
    source: Annotated[
        str,
        typer.Argument(metavar="IN", help="A photograph: jpeg, png, webp, tiff, bmp; or a directory, or '**/*.jpg'."),
    ],
    target: Annotated[
        Path, typer.Argument(metavar="OUT", help="Where to write it: .jpg, .png or .webp; for many, a directory.")
    ],
    what: Annotated[str, typer.Option("--correct", help="nonlinear or all.")] = "nonlinear",
    fit: Annotated[str, typer.Option(help="keep, crop, full, or a number 0..1 between crop and full.")] = "crop",
    strength: Annotated[float, typer.Option(help="0..1, blend with the original.")] = 1.0,
    quality: Annotated[int | None, typer.Option(min=1, max=100, help="Quality of jpeg and webp.")] = None,
    min_confidence: Annotated[
        float | None,
        typer.Option(min=0, max=1, help="Leave the picture alone below this confidence, else correct all the way."),
    ] = None,
    camera: Annotated[
        str | None, typer.Option(help="All photographs are of one camera: a name of yours; exif: as the files say.")
    ] = None,
    model: Annotated[str | None, typer.Option(help="Name of a shipped model, or a path.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace OUT if it is there.")] = False,
    workers: Annotated[int, typer.Option(min=0, help="Render workers for many photographs; 0: one a core.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Straighten a photograph, or many. Needs no running server.

    Of many, those whose result is there already are skipped, so that a command that was interrupted goes on where it
    was; results appear whole or not at all.
    """
    if is_batch(source):
        with errors_reported():
            jobs = find_jobs(source, target)
            batch_options = CorrectOptions(
                correct=Correct.parse(what),
                fit=Fit.parse(fit),
                strength=check_strength(strength),
                quality=quality,
                min_confidence=min_confidence,
                camera=camera,
            )
            batch_settings: dict[str, Any] = {"workers": workers} | ({} if model is None else {"model": model})
            batch = correct_jobs(read_settings(**batch_settings), jobs, batch_options, overwrite=overwrite)
        report_batch(batch, as_json)
        return
    with errors_reported():
        if target.exists() and not overwrite:
            fail(f"{target} is there already; --overwrite replaces it", 2)
        image_format = _FORMATS.get(target.suffix.lower())
        if image_format is None:
            raise InvalidOption(f"OUT ends in {target.suffix!r}.", allowed=", ".join(_FORMATS))
        options = CorrectOptions(
            correct=Correct.parse(what),
            fit=Fit.parse(fit),
            strength=check_strength(strength),
            quality=quality,
            image_format=image_format,
            min_confidence=min_confidence,
            camera=camera,
        )
        chosen: dict[str, Any] = {"workers": 1} | ({} if model is None else {"model": model})
        result = asyncio.run(_correct(read_settings(**chosen), Path(source).read_bytes(), options))
        target.write_bytes(result.body)
    _report(result, target, as_json)


async def _correct(settings: Settings, body: bytes, options: CorrectOptions) -> CorrectedImage:
    async with private_service(settings) as service:
        return await service.correction.of_image(body, options)


def _report(result: CorrectedImage, target: Path, as_json: bool) -> None:
    record = result.record
    if as_json:
        summary = {key: value for key, value in record.provenance().items() if key != "guides"}
        print_json({**summary, "out": str(target), "format": result.image_format})
        return
    console.print(f"{target}: {decision(record)}, confidence {record.confidence:.2f}, grid {record.id}", soft_wrap=True)
