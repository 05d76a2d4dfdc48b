"""``unbend estimate``."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from unbend_service.cli.private import private_service
from unbend_service.cli.reporting import console, decision, errors_reported, print_json
from unbend_service.cli.serve import read_settings
from unbend_service.domain.fit import Fit
from unbend_service.domain.records import Correct, GridRecord
from unbend_service.settings import Settings


def estimate(
    source: Annotated[Path, typer.Argument(metavar="IN", help="A photograph: jpeg, png, webp, tiff or bmp.")],
    what: Annotated[str, typer.Option("--correct", help="nonlinear or all.")] = "nonlinear",
    fit: Annotated[str, typer.Option(help="keep, crop, full, or a number 0..1 between crop and full.")] = "keep",
    strength: Annotated[float, typer.Option(help="0..1, blend with the identity.")] = 1.0,
    model: Annotated[str | None, typer.Option(help="Name of a shipped model, or a path.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the whole estimate, grid included, as JSON.")] = False,
) -> None:
    """Say how a photograph is bent. Needs no running server."""
    with errors_reported():
        correct, parsed_fit = Correct.parse(what), Fit.parse(fit)
        chosen: dict[str, Any] = {} if model is None else {"model": model}
        record = asyncio.run(_estimate(read_settings(**chosen), source.read_bytes(), correct, parsed_fit, strength))
    if as_json:
        print_json(record.to_dict())
    else:
        _print(record)


async def _estimate(settings: Settings, body: bytes, correct: Correct, fit: Fit, strength: float) -> GridRecord:
    async with private_service(settings, renders=False) as service:
        return await service.estimation.of_image(body, correct, fit, strength)


def _print(record: GridRecord) -> None:
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_row("outcome", decision(record))
    table.add_row("confidence", f"{record.confidence:.2f} ({record.confidence_kind.replace('_', ' ')})")
    table.add_row("displacement", f"{record.grid.displacement * 50:.2f} % of the width, mean")
    table.add_row("grid", f"{record.id} ({record.grid.rows}x{record.grid.columns})")
    table.add_row("model", record.model)
    console.print(table)
