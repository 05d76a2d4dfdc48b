"""``python -m deploy.checks.dashboard``: every query of the dashboard against the real service.

The service runs under real traffic, Prometheus scrapes it with the rules of this repository, and every query of the
dashboard, and every metric that a rule names, has to have values.
"""

from __future__ import annotations

import re
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.serving import served
from deploy.checks.dashboards import Query, queries
from deploy.checks.prometheus import RULES, Prometheus, scraping
from deploy.checks.traffic import SETTINGS, traffic

PATIENCE_S = 90.0
#: What Grafana would put for its variables: everything, and a window of ten scrapes.
VARIABLES = {"job": "unbend", "instance": ".*", "__rate_interval": "10s"}
_METRIC = re.compile(r"\b(unbend(?:_[a-z0-9]+)+|unbend(?::[a-z0-9_]+)+)\b")


def main() -> int:
    """Prints each query with the number of its series; 0 if all have some."""
    wanted = queries()
    with (
        tempfile.TemporaryDirectory() as folder,
        served(**SETTINGS) as service,
        traffic(service),
        scraping(service.http, Path(folder)) as prometheus,
    ):
        found, unknown = _watched(prometheus, wanted)
    for query, numbers in found.items():
        print(f"{'ok    ' if numbers else 'EMPTY '} {len(numbers):3d} series  {query.panel}: {query.text}")
    for name in sorted(unknown):
        print(f"EMPTY  a rule names {name}, which there is not")
    missing = sum(not numbers for numbers in found.values())
    print(f"{len(found) - missing} of {len(found)} queries return series; {len(unknown)} metrics of rules are unknown")
    return 1 if missing or unknown else 0


def rule_metrics() -> set[str]:
    """The names of the metrics of the service, and of the recorded ones, that the rules read or write."""
    text = "".join(path.read_text() for path in sorted(RULES.glob("*.yml")))
    return {name for name in _METRIC.findall(re.sub(r"#.*|[^\n]*- name:.*", "", text)) if "_" in name or ":" in name}


def _watched(prometheus: Prometheus, wanted: list[Query]) -> tuple[dict[Query, list[float]], set[str]]:
    """What each query returned at last, and what the rules name in vain; ends as soon as nothing is missing."""
    found: dict[Query, list[float]] = {query: [] for query in wanted}
    unknown = rule_metrics()
    deadline = time.monotonic() + PATIENCE_S
    while (unknown or not all(found.values())) and time.monotonic() < deadline:
        time.sleep(2)
        for query in wanted:
            found[query] = prometheus.numbers(query.with_variables(**VARIABLES)) or found[query]
        unknown = rule_metrics() - prometheus.metrics()
    return found, unknown


if __name__ == "__main__":
    sys.exit(main())
