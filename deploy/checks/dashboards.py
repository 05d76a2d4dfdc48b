"""Reads the Grafana dashboard: its panels, and the queries behind them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

DASHBOARD = Path(__file__).parent.parent / "grafana/dashboards/unbend.json"


@dataclass(frozen=True, slots=True)
class Query:
    """One query of one panel, in PromQL with Grafana's variables in it."""

    panel: str
    text: str

    def with_variables(self, **values: str) -> str:
        """PromQL alone: each ``$name`` is replaced; longer names first, as one may begin with another."""
        text = self.text
        for name in sorted(values, key=len, reverse=True):
            text = text.replace(f"${name}", values[name])
        return text


def panels(dashboard: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Every panel that shows something, those inside of closed rows too."""
    for panel in dashboard["panels"]:
        if panel["type"] == "row":
            yield from panel["panels"]
        else:
            yield panel


def queries(path: Path = DASHBOARD) -> list[Query]:
    """Every query of the dashboard, in the order of its panels."""
    dashboard = json.loads(path.read_text())
    return [Query(panel["title"], target["expr"]) for panel in panels(dashboard) for target in panel["targets"]]
