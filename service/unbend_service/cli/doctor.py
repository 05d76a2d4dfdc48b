"""``unbend doctor``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from typing import Annotated

import typer
from rich.table import Table
from rich.text import Text

from unbend_service.cli.diagnosis.finding import Finding
from unbend_service.cli.diagnosis.graphics import examine_graphics
from unbend_service.cli.diagnosis.machine import (
    examine_cores,
    examine_grid_store,
    examine_grpc_port,
    examine_http_port,
    examine_memory,
)
from unbend_service.cli.diagnosis.packages import examine_extras, examine_turbojpeg, examine_versions
from unbend_service.cli.diagnosis.weights import examine_model
from unbend_service.cli.reporting import EXIT_FAILED, console, print_json
from unbend_service.cli.serve import read_settings
from unbend_service.settings import Settings

_COLOURS = {"ok": "green", "note": "yellow", "bad": "red"}


def doctor(as_json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")] = False) -> None:
    """Say what this machine offers, what is missing, and how to mend it. Ends with 1 if the service cannot work."""
    findings = list(examine(read_settings()))
    healthy = all(finding.status != "bad" for finding in findings)
    if as_json:
        print_json({"healthy": healthy, "findings": [asdict(finding) for finding in findings]})
    else:
        _print(findings)
    if not healthy:
        raise typer.Exit(EXIT_FAILED)


def examine(settings: Settings) -> Iterator[Finding]:
    """Everything that decides whether, and how well, the service works with these settings on this machine."""
    yield from examine_versions()
    yield examine_turbojpeg()
    yield examine_cores()
    yield examine_memory(settings)
    yield from examine_graphics(settings)
    yield examine_model(settings)
    yield examine_http_port(settings)
    yield examine_grpc_port(settings)
    yield examine_grid_store(settings)
    yield from examine_extras()


def _print(findings: list[Finding]) -> None:
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column()
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for finding in findings:
        remedy = f"\n→ {finding.remedy}" if finding.remedy else ""
        # text, not markup: what is said of 'unbend[video]' must not be taken for a style
        table.add_row(Text(finding.status, _COLOURS[finding.status]), finding.name, Text(finding.detail + remedy))
    console.print(table)
