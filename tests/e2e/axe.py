"""What axe-core finds on a page."""

from __future__ import annotations

from typing import Any


def violations(page: Any) -> list[str]:
    """Rule, weight and place of whatever is serious or critical."""
    from axe_playwright_python.sync_playwright import Axe

    found = Axe().run(page).response
    assert len(found["passes"]) > 10, "it has looked"
    return [
        f"{rule['id']} ({rule['impact']}): {node['target']} {node['failureSummary']}"
        for rule in found["violations"]
        if rule["impact"] in ("serious", "critical")
        for node in rule["nodes"]
    ]
