"""``unbend grid``: look at grids, and take them to and from other programs."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from unbend_service.cli.grid_source import load_record, store_record
from unbend_service.cli.reporting import console, errors_reported, fail, print_json
from unbend_service.cli.server import Server, reaches_server
from unbend_service.domain.errors import InvalidOption
from unbend_service.domain.exchange import Direction, ExportFormat, ExportOptions, ImportFormat, ImportOptions
from unbend_service.domain.fit import Fit, check_strength
from unbend_service.domain.grid import Grid
from unbend_service.domain.inversion import InverseMap
from unbend_service.domain.maps import target_lattice
from unbend_service.domain.records import GridRecord
from unbend_service.wiring import build_exchange

grid = typer.Typer(name="grid", help="Look at grids, and take them to and from other programs.", no_args_is_help=True)

GridArgument = Annotated[
    str, typer.Argument(metavar="GRID", help="A JSON file, or an id on the server or in the private store.")
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace OUT if it is there.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
_BY_SUFFIX = {
    ".json": ExportFormat.JSON,
    ".npz": ExportFormat.NPZ,
    ".exr": ExportFormat.STMAP_EXR,
    ".tif": ExportFormat.STMAP_TIFF,
    ".tiff": ExportFormat.STMAP_TIFF,
    ".zip": ExportFormat.FFMPEG,
}


@grid.command()
@reaches_server
def show(source: GridArgument, server: Server | None = None, as_json: JsonOption = False) -> None:
    """Say what a grid does. Unlike `unbend show`, which draws it over a picture."""
    with errors_reported():
        record = load_record(source, server)
    if as_json:
        print_json(record.to_dict())
        return
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_row("grid", f"{record.id} ({record.grid.rows}x{record.grid.columns})")
    table.add_row("displacement", f"{record.grid.displacement * 50:.2f} % of the width, mean")
    table.add_row("folds", "no" if record.grid.is_unfolded else "yes")
    table.add_row("confidence", f"{record.confidence:.2f} ({record.confidence_kind.replace('_', ' ')})")
    table.add_row("strength", f"{record.strength:g}")
    table.add_row("model", record.model or "none: it was not estimated")
    console.print(table)


@grid.command()
@reaches_server
def export(
    source: GridArgument,
    target: Annotated[Path, typer.Argument(metavar="OUT", help="Its suffix chooses the format if --format does not.")],
    kind: Annotated[
        ExportFormat | None, typer.Option("--format", help="What to write; by default what the suffix of OUT says.")
    ] = None,
    width: Annotated[int | None, typer.Option(min=1, help="Pixels of both pictures; not of json.")] = None,
    height: Annotated[int | None, typer.Option(min=1, help="Pixels of both pictures; not of json.")] = None,
    direction: Annotated[
        Direction, typer.Option(help="The map that draws the straight picture, or the bent one from it.")
    ] = Direction.UNDISTORT,
    fit: Annotated[str, typer.Option(help="keep, crop, full, or a number 0..1 between crop and full.")] = "keep",
    strength: Annotated[float, typer.Option(help="0..1, blend with the identity.")] = 1.0,
    server: Server | None = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write a grid as a file of another program: OpenCV, Nuke, Blender, ffmpeg."""
    with errors_reported():
        _check_free(target, overwrite)
        chosen = kind or _BY_SUFFIX.get(target.suffix.lower())
        if chosen is None:
            raise InvalidOption(f"OUT ends in {target.suffix!r}.", allowed=f"{', '.join(_BY_SUFFIX)}, or --format")
        options = ExportOptions(width, height, direction, Fit.parse(fit), check_strength(strength))
        _write(load_record(source, server), target, chosen, options)
    _report(target, {"out": str(target), "format": chosen.value, "direction": direction.value}, as_json)


@grid.command("import")
@reaches_server
def read(
    source: Annotated[Path, typer.Argument(metavar="IN", help="A file of another program.")],
    target: Annotated[Path | None, typer.Argument(metavar="[OUT]", help="A JSON file to write the grid to.")] = None,
    kind: Annotated[ImportFormat | None, typer.Option("--format", help="What IN is; by default by its suffix.")] = None,
    direction: Annotated[Direction, typer.Option(help="Which picture the map in IN draws.")] = Direction.UNDISTORT,
    points: Annotated[int, typer.Option(min=2, max=1025, help="Rows and columns of the grid that is made.")] = 129,
    server: Server | None = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Read a grid from a file of another program; without OUT it is stored on the server or in the private store."""
    with errors_reported():
        if target is not None:
            _check_free(target, overwrite)
        chosen = kind or _read_as(source)
        options = ImportOptions(direction, points)
        record = _import(source, chosen, options, target, server)
    _report(target, {"grid_id": record.id, "out": None if target is None else str(target)}, as_json, record)


@grid.command()
@reaches_server
def invert(
    source: GridArgument,
    target: Annotated[Path, typer.Argument(metavar="OUT", help="A JSON file.")],
    server: Server | None = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write the grid that bends a straight picture the way the lens did."""
    with errors_reported():
        _check_free(target, overwrite)
        record = load_record(source, server)
        options = ExportOptions(direction=Direction.REDISTORT)
        _write(record, target, ExportFormat.JSON, options)
        error_px = _round_trip_px(record.grid)
    summary = {"out": str(target), "round_trip_error_px_at_1024": error_px}
    if as_json:
        print_json(summary)
    else:
        console.print(f"{target}: there and back within {error_px:.3f} px of 1024", soft_wrap=True)


def _write(record: GridRecord, target: Path, kind: ExportFormat, options: ExportOptions) -> None:
    file = asyncio.run(build_exchange().export(record, kind, options))
    target.write_bytes(file.body)


def _import(
    source: Path, kind: ImportFormat, options: ImportOptions, target: Path | None, server: Server | None
) -> GridRecord:
    record = asyncio.run(build_exchange().read(source.read_bytes(), kind, options))
    if target is not None:
        _write(record, target, ExportFormat.JSON, ExportOptions())
    if server is not None or target is None:
        store_record(record, server)
    return record


def _read_as(source: Path) -> ImportFormat:
    suffixes = {".yml": ImportFormat.OPENCV, ".yaml": ImportFormat.OPENCV}
    written = _BY_SUFFIX.get(source.suffix.lower())
    found = suffixes.get(source.suffix.lower())
    if found is None and written is not None and written.value in set(ImportFormat):
        found = ImportFormat(written.value)
    if found is None:
        raise InvalidOption(f"IN ends in {source.suffix!r}.", allowed="--format " + ", ".join(ImportFormat))
    return found


def _round_trip_px(lattice: Grid) -> float:
    """Largest distance, in pixels of a 1024 pixel wide picture, of visible points that go there and back."""
    points = target_lattice(101, 101)
    source = lattice(points)
    seen = (abs(source) <= 1).all(axis=-1)
    return float(abs(InverseMap(lattice)(source[seen]) - points[seen]).max(initial=0.0) * 512)


def _check_free(target: Path, overwrite: bool) -> None:
    if target.exists() and not overwrite:
        fail(f"{target} is there already; --overwrite replaces it", 2)


def _report(
    target: Path | None, summary: dict[str, str | None], as_json: bool, record: GridRecord | None = None
) -> None:
    if as_json:
        print_json(dict(summary))
    elif record is not None:
        console.print(f"{target or 'stored'}: grid {record.id}", soft_wrap=True)
    else:
        console.print(f"{target}: {summary['format']}, {summary['direction']}", soft_wrap=True)
