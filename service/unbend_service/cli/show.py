"""``unbend show``: figures of what an estimate says of a photograph."""

from __future__ import annotations

import asyncio
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from unbend_service.adapters.drawing import figures
from unbend_service.adapters.drawing.overlay import OverlayIllustrator
from unbend_service.application.correction import CorrectOptions
from unbend_service.application.ports import DecodedImage
from unbend_service.cli.grid_source import load_record
from unbend_service.cli.private import private_service
from unbend_service.cli.reporting import console, errors_reported, fail
from unbend_service.cli.serve import read_settings
from unbend_service.domain.errors import InvalidOption
from unbend_service.domain.fit import Fit
from unbend_service.domain.frames import Frame
from unbend_service.domain.records import Correct, GridRecord
from unbend_service.settings import Settings

_FORMATS = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg", ".webp": "webp", ".svg": "svg"}


class Figure(StrEnum):
    """What is shown."""

    GUIDES = "guides"
    GRID = "grid"
    GRIDS = "grids"
    DISPLACEMENT = "displacement"
    MAGNITUDE = "magnitude"
    SHEET = "sheet"


def show(
    source: Annotated[Path, typer.Argument(metavar="IN", help="A photograph: jpeg, png, webp, tiff or bmp.")],
    target: Annotated[Path, typer.Argument(metavar="OUT", help=".png, .jpg, .webp; .svg of guides and grid.")],
    figure: Annotated[Figure, typer.Option("--what", help="What is shown.")] = Figure.SHEET,
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
        if image_format == "svg" and figure not in (Figure.GUIDES, Figure.GRID):
            raise InvalidOption(f"{figure} is not drawn as SVG.", allowed="--what guides or grid, or .png")
        given = None if grid is None else load_record(grid, None)
        options = CorrectOptions(correct=Correct.parse(what), fit=Fit.parse(fit))
        chosen: dict[str, Any] = {"workers": 1} | ({} if model is None else {"model": model})
        body = asyncio.run(_figure(read_settings(**chosen), source.read_bytes(), figure, given, options, image_format))
        target.write_bytes(body)
    console.print(f"{target}: {figure.value}", soft_wrap=True)


async def _figure(
    settings: Settings, body: bytes, figure: Figure, given: GridRecord | None, options: CorrectOptions, kind: str
) -> bytes:
    async with private_service(settings) as service:
        frame = service.codec.decode(body).frame
        record = given or await service.estimation.of_image(body, options.correct)
        if figure is Figure.GUIDES and record.guides is None:
            raise InvalidOption(f"The grid {record.id} has no guides.", allowed="--what grid or displacement")
        if kind == "svg":
            vectors = figures.svg_of(frame, record.guides if figure is Figure.GUIDES else None, record.grid)
            return vectors.encode()
        straight = frame
        if figure in (Figure.GRIDS, Figure.SHEET):
            straight = await service.correction.render(frame, record, options)
        drawn = _drawn(figure, frame, straight, record)
        return service.codec.encode(DecodedImage(drawn, "png"), kind, 92)


def _drawn(figure: Figure, frame: Frame, straight: Frame, record: GridRecord) -> Frame:
    illustrator = OverlayIllustrator()
    if figure is Figure.GUIDES and record.guides is not None:
        return illustrator.guides(frame, record.guides)
    if figure is Figure.GRID:
        return illustrator.grid(frame, record.grid)
    if figure is Figure.GRIDS:
        return figures.grids_figure(frame, straight, record.grid)
    if figure is Figure.DISPLACEMENT:
        return illustrator.displacement(frame, record.grid)
    if figure is Figure.MAGNITUDE:
        return figures.magnitude_figure(frame, record.grid)
    return figures.sheet_figure(frame, straight, record.guides, record.grid)
