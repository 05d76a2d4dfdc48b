"""Rules, alerts, runbooks and the dashboard, read by Prometheus itself."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

from deploy.checks.dashboard import rule_metrics
from deploy.checks.dashboards import DASHBOARD, panels, queries

ROOT = Path(__file__).parent.parent.parent
RULES = sorted((ROOT / "deploy/prometheus/rules").glob("*.yml"))
ALERTS = [
    rule
    for path in RULES
    for group in yaml.safe_load(path.read_text())["groups"]
    for rule in group["rules"]
    if "alert" in rule
]

needs_prometheus = pytest.mark.skipif(shutil.which("promtool") is None, reason="apt-get install prometheus")


def promtool(*arguments: str | Path) -> None:
    done = subprocess.run(["promtool", *map(str, arguments)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@needs_prometheus
def test_promtool_finds_nothing_wrong_with_the_rules() -> None:
    promtool("check", "rules", *RULES)


@needs_prometheus
def test_alerts_fire_when_they_should_and_only_then() -> None:
    promtool("test", "rules", *sorted((ROOT / "deploy/prometheus/tests").glob("*.yml")))


@needs_prometheus
def test_prometheus_takes_the_configuration_of_the_compose_file() -> None:
    promtool("check", "config", "--syntax-only", ROOT / "deploy/compose/prometheus.yml")


@pytest.mark.parametrize("alert", ALERTS, ids=lambda alert: alert["alert"])
def test_an_alert_has_a_test_and_a_page_that_says_what_to_do(alert: dict[str, object]) -> None:
    name = alert["alert"]
    tests = "".join(path.read_text() for path in (ROOT / "deploy/prometheus/tests").glob("*.yml"))
    assert f"alertname: {name}" in tests
    annotations = alert["annotations"]
    assert isinstance(annotations, dict)
    page = ROOT / annotations["runbook"]
    text = page.read_text()
    assert text.startswith(f"# {name}\n")
    for heading in ("## What it means", "## What to look at", "## What to do"):
        assert heading in text


def test_every_page_is_that_of_an_alert() -> None:
    pages = {path.stem for path in (ROOT / "docs/runbooks").glob("*.md")} - {"README"}
    assert pages == {rule["alert"] for rule in ALERTS}


def test_pages_and_rules_name_metrics_of_the_dashboard_or_of_the_service() -> None:
    recorded = {name for name in rule_metrics() if ":" in name}
    shown = " ".join(query.text for query in queries())
    used = " ".join(str(rule["expr"]) for rule in ALERTS) + shown
    unused = {name for name in recorded if name not in used}
    assert unused == set(), "recorded and never looked at"


def test_the_dashboard_fits_its_grid_and_no_panel_lies_on_another() -> None:
    taken: set[tuple[int, int]] = set()
    for panel in panels(json.loads(DASHBOARD.read_text())):
        place = panel["gridPos"]
        cells = {
            (x, y)
            for x in range(place["x"], place["x"] + place["w"])
            for y in range(place["y"], place["y"] + place["h"])
        }
        assert not cells & taken, panel["title"]
        assert max(x for x, _ in cells) < 24
        taken |= cells


def test_every_query_uses_only_variables_that_the_dashboard_has() -> None:
    dashboard = json.loads(DASHBOARD.read_text())
    known = {each["name"] for each in dashboard["templating"]["list"]} | {"__rate_interval"}
    for query in queries():
        assert set(re.findall(r"\$(\w+)", query.text)) <= known, query.panel


@needs_prometheus
@pytest.mark.deploy
def test_every_query_of_the_dashboard_returns_series_from_the_real_service(capsys: pytest.CaptureFixture[str]) -> None:
    from deploy.checks.dashboard import main

    assert main() == 0, capsys.readouterr().out
