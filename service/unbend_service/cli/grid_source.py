"""Where a command gets its grid from: a JSON file, a server, or the private store."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import TypeVar

import unbend
from unbend_service.application.ports import GridStore
from unbend_service.cli.serve import read_settings
from unbend_service.cli.server import Server
from unbend_service.domain.errors import GridNotFound, InvalidOption, Refused, Unavailable, UnbendError
from unbend_service.domain.exchange import ImportFormat, ImportOptions
from unbend_service.domain.grid import Grid
from unbend_service.domain.guides import Guides
from unbend_service.domain.records import GridRecord, Outcome, Reason
from unbend_service.wiring import build_exchange, build_store

T = TypeVar("T")


def load_record(source: str, server: Server | None) -> GridRecord:
    """The record of a JSON file if there is one of that name, else of that id on ``server`` or in the private store.

    The private store outlives a command if it is ``sqlite`` (UNBEND_GRID_STORE).

    Raises:
        GridNotFound, InvalidGrid, InvalidGuides, Unavailable.
    """
    path = Path(source)
    if path.suffix == ".json" or path.is_file():
        return asyncio.run(build_exchange().read(path.read_bytes(), ImportFormat.JSON, ImportOptions()))
    if server is not None:
        return record_of(_called(server, lambda client: client.grids.get(source)))
    return asyncio.run(_privately(lambda store: store.get(source)))


def store_record(record: GridRecord, server: Server | None) -> None:
    """Keeps the grid on ``server``, or in the private store. Raises as :func:`load_record`."""
    if server is not None:
        _called(server, lambda client: client.grids.put(unbend.Grid(record.grid.source)))
    else:
        asyncio.run(_privately(lambda store: store.put(record)))


async def _privately(call: Callable[[GridStore], Awaitable[T]]) -> T:
    store = build_store(read_settings())
    try:
        return await call(store)
    finally:
        await store.close()


def _called(server: Server, call: Callable[[unbend.Client], unbend.GridRecord]) -> unbend.GridRecord:
    try:
        with unbend.Client(server.address, **server.arguments) as client:
            return call(client)
    except unbend.UnbendError as error:
        raise translated(error, server) from error


def translated(error: unbend.UnbendError, server: Server) -> UnbendError:
    """An error of the client as one that commands report: what was sent, or that the server cannot do it now."""
    if isinstance(error, unbend.GridNotFound):
        return GridNotFound(str(error))
    if isinstance(error, unbend.InvalidInput):
        return InvalidOption(str(error))
    if isinstance(error, unbend.Refused):
        return Refused(f"{server}: {error}", allowed="a token: --token-file or UNBEND_TOKEN")
    return Unavailable(f"{server}: {error}")


def record_of(found: unbend.GridRecord) -> GridRecord:
    """The client's record as the domain's. Raises InvalidGrid for one without its lattice."""
    if found.grid is None:
        raise GridNotFound(f"The server sent no lattice of {found.grid_id}.")
    return GridRecord(
        Grid(found.grid.source),
        None if found.guides is None else Guides.from_dict(_guides(found.guides)),
        found.confidence,
        found.confidence_kind,
        Outcome(str(found.outcome)),
        Reason(found.reason),
        found.strength,
        found.model,
    )


def _guides(guides: unbend.Guides) -> dict[str, list[dict[str, object]]]:
    def family(members: Sequence[unbend.Guide]) -> list[dict[str, object]]:
        return [{"anchor": guide.anchor, "coefficients": list(guide.coefficients)} for guide in members]

    return {"rows": family(guides.rows), "columns": family(guides.columns)}
