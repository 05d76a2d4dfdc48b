"""The command line: one verb a module."""

from __future__ import annotations

import typer

from unbend_service.cli.annotate import annotate
from unbend_service.cli.correct import correct
from unbend_service.cli.doctor import doctor
from unbend_service.cli.estimate import estimate
from unbend_service.cli.eval import evaluate
from unbend_service.cli.grid import grid
from unbend_service.cli.serve import serve
from unbend_service.cli.show import show
from unbend_service.cli.token import token
from unbend_service.cli.video import video

app = typer.Typer(
    name="unbend",
    help="Straightens photographs and video from unknown cameras.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
for verb in (serve, correct, video, show, estimate, annotate, doctor):
    app.command()(verb)
app.command("eval")(evaluate)
app.add_typer(grid)
app.add_typer(token)


def main() -> None:
    """Entry point of the ``unbend`` command."""
    app()
