"""``unbend token``: tokens for a service that asks for them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from unbend_service.cli.reporting import errors, fail
from unbend_service.domain.access import Grant, Scope, check_name, digest_of, line_of, new_token

token = typer.Typer(name="token", help="Tokens for a service that asks for them.", no_args_is_help=True)


@token.callback()
def group() -> None:
    """Keeps `new` a command of its own."""


@token.command()
def new(
    name: Annotated[str, typer.Argument(help="Stands in logs; a token that is exchanged keeps its name.")],
    scope: Annotated[list[Scope], typer.Option(help="What it is good for; may be repeated.")],
    file: Annotated[Path | None, typer.Option(help="Tokens file to which its line is added.")] = None,
    rate: Annotated[float | None, typer.Option(min=0.001, help="Pictures and frames a second.")] = None,
    burst: Annotated[int | None, typer.Option(min=1, help="Pictures and frames at once.")] = None,
    streams: Annotated[int | None, typer.Option(min=1, help="Streams at once.")] = None,
) -> None:
    """Make a token. It is shown once: the file keeps its digest only."""
    try:
        check_name(name)
    except ValueError as error:
        fail(f"{error}, not {name!r}", 2)
    secret = new_token()
    line = line_of(Grant(name, frozenset(scope), digest_of(secret), rate, burst, streams))
    if file is None:
        typer.echo(f"token, shown this once:      {secret}")
        typer.echo(f"line for UNBEND_TOKENS_FILE: {line}")
        return
    try:
        _add(file, line)
    except OSError as error:
        fail(f"{file}: {error.strerror}")
    typer.echo(secret)
    errors.print(f"added to {file}; a running service reads it within a second", style="dim", highlight=False)


def _add(file: Path, line: str) -> None:
    """One write at the end, so that a service never reads half a line."""
    descriptor = os.open(file, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o600)
    with os.fdopen(descriptor, "a+b") as opened:
        size_bytes = opened.seek(0, os.SEEK_END)
        ended = size_bytes == 0 or os.pread(descriptor, 1, size_bytes - 1) == b"\n"
        opened.write(f"{'' if ended else chr(10)}{line}\n".encode())
