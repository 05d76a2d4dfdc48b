"""What commands print, and how they end.

Exit codes: 0 done; 1 the service or a file failed; 2 the command line is wrong; 3 the input is not acceptable.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NoReturn

import orjson
import typer
from rich.console import Console

from unbend_service.domain.errors import InvalidInput, UnbendError
from unbend_service.domain.records import GridRecord

EXIT_FAILED = 1
EXIT_INVALID_INPUT = 3

console = Console()
errors = Console(stderr=True)


def print_json(value: dict[str, Any]) -> None:
    """One JSON object on standard output."""
    typer.echo(orjson.dumps(value, option=orjson.OPT_INDENT_2).decode())


def fail(message: str, exit_code: int = EXIT_FAILED) -> NoReturn:
    """Says on standard error what went wrong and ends the command."""
    errors.print("unbend:", message, style="red", markup=False, highlight=False, soft_wrap=True)
    raise typer.Exit(exit_code)


@contextmanager
def errors_reported() -> Iterator[None]:
    """Turns the errors that a user can cause into one sentence and an exit code."""
    try:
        yield
    except InvalidInput as error:
        fail(str(error), EXIT_INVALID_INPUT)
    except UnbendError as error:
        fail(str(error))
    except OSError as error:
        fail(f"{error.strerror or error}{f': {error.filename}' if error.filename else ''}")


def decision(record: GridRecord) -> str:
    """Of an estimate, in words: the outcome, how much of it, and why no more."""
    outcome = record.outcome.value.replace("_", " ")
    share = f", {record.strength:.0%} of it" if 0 < record.strength < 1 else ""
    reason = f" ({record.reason.value.replace('_', ' ')})" if record.reason else ""
    return outcome + share + reason
