"""Writes the table and the plot of committed results: ``python -m benchmarks summary``."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
README = HERE / "README.md"
BEGIN, END = "<!-- results: written by `make bench-summary` -->", "<!-- end of results -->"
_ROW_PX, _LABEL_PX, _WIDTH_PX, _LARGEST = 24, 560, 960, 2.5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("--results", type=Path, default=HERE / "results", help="folder of results by machine")


def run(arguments: argparse.Namespace) -> int:
    """Puts every machine's results into the README, with one plot a machine beside its files."""
    parts = []
    for folder in sorted(path for path in arguments.results.iterdir() if path.is_dir()):
        suites = [json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))]
        (folder / "ratios.svg").write_text(plot(suites))
        parts.append(table(folder.name, suites))
    text = README.read_text()
    start, end = text.index(BEGIN) + len(BEGIN), text.index(END)
    README.write_text(text[:start] + "\n\n" + "\n".join(parts) + "\n" + text[end:])
    return 0


def table(name: str, suites: list[dict[str, Any]]) -> str:
    """Markdown: ratios against their bars, then every measurement."""
    machine = suites[0]["machine"]
    lines = [
        f"### {name}",
        "",
        f"{machine['processor']}, {machine['cores']} cores, {machine['memory_gib']} GiB, {machine['system']}, "
        f"Python {machine['python']}. " + ", ".join(f"{s['suite']} at {s['commit']}" for s in suites) + ".",
        "",
        f"![Ratios](results/{name}/ratios.svg)",
        "",
        "| Promise | Measured | Bar | |",
        "|---|---:|---:|---|",
    ]
    for suite in suites:
        for label, ratio in suite["ratios"].items():
            lines.append(f"| {label} | {ratio['value']} | {ratio['bar']} | {'met' if ratio['ok'] else '**missed**'} |")
    lines += ["", "| Measurement | Ours, ms (IQR) | Peer, ms (IQR) | Ours / peer | More |", "|---|---:|---:|---:|---|"]
    for suite in suites:
        lines += [_line(row) for row in suite["rows"]]
    return "\n".join(lines) + "\n"


def _line(row: dict[str, Any]) -> str:
    known = {"name", "ours", "peer", "ratio"}
    more = ", ".join(f"{key} {_short(value)}" for key, value in row.items() if key not in known)
    ratio = f"{row['ratio']:.2f}" if "ratio" in row else ""
    return f"| {row['name']} | {_timing(row.get('ours'))} | {_timing(row.get('peer'))} | {ratio} | {more} |"


def _timing(value: dict[str, float] | None) -> str:
    return "" if value is None else f"{value['median_s'] * 1e3:.2f} ({value['iqr_s'] * 1e3:.2f})"


def _short(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def plot(suites: list[dict[str, Any]]) -> str:
    """SVG: one bar a ratio, as long as the ratio is large in units of its bar; a line stands where the bar is met."""
    ratios = [(label, ratio) for suite in suites for label, ratio in suite["ratios"].items()]
    height = _ROW_PX * (len(ratios) + 1)
    unit = (_WIDTH_PX - _LABEL_PX - 80) / _LARGEST
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{_WIDTH_PX}" height="{height}" font-family="sans-serif" '
        f'font-size="12"><rect width="100%" height="100%" fill="white"/>'
    ]
    for number, (label, ratio) in enumerate(ratios):
        relation, bar = ratio["bar"].split()
        share = ratio["value"] / float(bar) if float(bar) else 1.0 + ratio["value"]
        top = number * _ROW_PX + 4
        length = min(max(share, 0.0), _LARGEST) * unit
        parts.append(
            f'<text x="{_LABEL_PX - 8}" y="{top + 13}" text-anchor="end">{label.replace("<", "&lt;")}</text>'
            f'<rect x="{_LABEL_PX}" y="{top}" width="{length:.0f}" height="{_ROW_PX - 8}" '
            f'fill="{"#3a7d44" if ratio["ok"] else "#c1440e"}"/>'
            f'<text x="{_LABEL_PX + length + 4:.0f}" y="{top + 13}">{ratio["value"]} '
            f"({relation.replace('<', '&lt;').replace('>', '&gt;')} {bar})</text>"
        )
    met = _LABEL_PX + unit
    parts.append(f'<line x1="{met:.0f}" x2="{met:.0f}" y1="0" y2="{height}" stroke="#222" stroke-dasharray="4"/></svg>')
    return "\n".join(parts) + "\n"
