"""``unbend show``: figures of what an estimate says of a photograph."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Annotated, Any

import typer

from unbend_service.application.correction import CorrectOptions
from unbend_service.application.exhibit import Subject
from unbend_service.cli.grid_source import load_record
from unbend_service.cli.private import private_service
from unbend_service.cli.reporting import console, errors_reported, fail
from unbend_service.cli.serve import read_settings
from unbend_service.domain.errors import InvalidOption
from unbend_service.domain.fit import Fit
from unbend_service.domain.records import Correct, GridRecord
from unbend_service.settings import Settings

_FORMATS = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg", ".webp": "webp", ".svg": "svg"}


def show(
    source: Annotated[Path, typer.Argument(metavar="IN", help="A photograph: jpeg, png, webp, tiff or bmp.")],
    target: Annotated[Path, typer.Argument(metavar="OUT", help=".png, .jpg, .webp, or .svg.")],
    figure: Annotated[Subject, typer.Option("--what", help="What is shown.")] = Subject.SHEET,
    what: Annotated[str, typer.Option("--correct", help="nonlinear or all.")] = "nonlinear",
    fit: Annotated[str, typer.Option(help="Of the corrected picture: keep, crop, full, or 0..1.")] = "crop",
    grid: Annotated[str | None, typer.Option(help="A JSON file or an id: that grid instead of an estimate.")] = None,
    model: Annotated[str | None, typer.Option(help="Name of a shipped model, or a path.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace OUT if it is there.")] = False,
) -> None:
    """Draw guides, grids and displacement over a photograph, as figures for a paper."""
    with errors_reported():
        if target.exists() and not overwrite:
            fail(f"{target} is there already; --overwrite replaces it", 2)
        image_format = _FORMATS.get(target.suffix.lower())
        if image_format is None:
            raise InvalidOption(f"OUT ends in {target.suffix!r}.", allowed=", ".join(_FORMATS))
        given = None if grid is None else load_record(grid, None)
        options = CorrectOptions(correct=Correct.parse(what), fit=Fit.parse(fit), image_format=image_format)
        chosen: dict[str, Any] = {"workers": 1} | ({} if model is None else {"model": model})
        body = asyncio.run(_drawn(read_settings(**chosen), source.read_bytes(), figure, given, options))
        target.write_bytes(body)
    console.print(f"{target}: {figure.value}", soft_wrap=True)


async def _drawn(
    settings: Settings, body: bytes, subject: Subject, given: GridRecord | None, options: CorrectOptions
) -> bytes:
    async with private_service(settings, renders=subject.shows_result) as service:
        return (await service.illustration.of_image(body, subject, options, given=given)).body
