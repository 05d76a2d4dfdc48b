from __future__ import annotations

import json
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent


def test_the_plan_starts_from_what_was_measured() -> None:
    """The measured figures of the page are those of the committed results, and the plan's cores follow from them."""
    page = (ROOT / "docs/capacity.md").read_text()
    rows = json.loads((ROOT / "benchmarks/results/two-cores/replicas.json").read_text())["rows"]
    costs = {row["name"].split(" ")[0]: row for row in rows if "processor time a frame" in row["name"]}
    cores = []
    for kind in ("jpeg", "i420"):
        service_ms = costs[kind]["service_cpu_ms"]
        assert f"{service_ms:.1f} ms" in page
        assert f"{costs[kind]['haproxy_cpu_ms']:.1f} ms" in page
        assert f"{costs[kind]['kib_in']:.0f} KiB" in page
        cores.append(f"{300_000 * service_ms / 1000:,.0f}")
    assert f"| service: cores busy | {' | '.join(cores)} |" in page
    (estimate,) = (row for row in rows if row["name"].startswith("an estimate"))
    assert f"{estimate['service_cpu_ms']:.1f} ms each" in page
