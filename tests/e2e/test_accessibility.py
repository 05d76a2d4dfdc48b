"""axe-core looks at the pages as they are used: nothing serious or critical by its rules."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.acceptance.conftest import Server
from tests.e2e.axe import violations
from tests.e2e.conftest import ROOT

SAMPLE = ROOT / "service/unbend_service/web/samples/facade.jpg"


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_state_of_the_page_is_open_to_all(
    service: Server, visit: Callable[..., Any], scheme: str, tmp_path: Path
) -> None:
    """Names, contrast and roles hold before, with a picture, with a saved grid, while guides are dragged, in errors."""
    page = visit(f"http://{service.http}/", scheme=scheme)
    assert violations(page) == []
    (tmp_path / "notes.txt").write_text("not a picture")
    page.set_input_files("#file", tmp_path / "notes.txt")
    page.wait_for_selector("#error:not([hidden])")
    assert violations(page) == []
    page.set_input_files("#file", SAMPLE)
    page.wait_for_selector("#work:not([hidden])")
    for overlay in ("guides", "grid", "arrows"):
        page.click(f"[data-overlay={overlay}]")
    page.click("#save")
    page.wait_for_selector("#saved:not([hidden])")
    assert violations(page) == []
    page.click("#adjust")
    page.wait_for_selector("#adjusting:not([hidden])")
    assert violations(page) == []


def test_the_page_of_the_api_is_open_to_all(service: Server, visit: Callable[..., Any]) -> None:
    """As it is when it has been filled, and axe is no blind judge: faint words are found."""
    page = visit(f"http://{service.http}/")
    page.click("nav a:text-is('API')")
    page.wait_for_selector("details")
    assert violations(page) == []
    page.evaluate("document.getElementById('title').style.color = '#ccc'")
    assert any("color-contrast" in violation for violation in violations(page))
