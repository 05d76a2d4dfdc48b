from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.acceptance.conftest import Server, start_server, stop_server
from tests.access.scan import Tokens
from tests.e2e.conftest import shoot
from unbend_service.domain.access import Grant, Scope, digest_of, line_of, new_token

Visit = Callable[..., Any]
FACADE = Path(__file__).parent.parent.parent / "service/unbend_service/web/samples/facade.jpg"


@dataclass
class Guarded:
    server: Server
    token: str
    other: str

    @property
    def address(self) -> str:
        return f"http://{self.server.http}/"


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guarded]:
    file = tmp_path_factory.mktemp("tokens") / "tokens"
    tokens, token = Tokens(), new_token()
    tokens.write(file)
    with file.open("a") as lines:
        lines.write(line_of(Grant("page", frozenset({Scope.CORRECT, Scope.GRIDS}), digest_of(token))) + "\n")
    server = start_server(workers="1", renderer="cpu", tokens_file=str(file))
    yield Guarded(server, token, tokens.only[Scope.METRICS])
    assert stop_server(server) == 0


def give(page: Any, token: str) -> None:
    page.fill("dialog #token", token)
    page.keyboard.press("Enter")


def test_the_page_asks_for_a_token_and_works_with_it(guarded: Guarded, visit: Visit) -> None:
    """A wrong one is asked for again; the picture that was dropped before is not lost; grids and exports work too."""
    page = visit(guarded.address)
    page.set_input_files("#file", FACADE)
    page.wait_for_selector("dialog.token")
    shoot(page, "token")
    give(page, guarded.token + "x")
    page.wait_for_selector("text=not known here")
    give(page, guarded.other)
    page.wait_for_selector("text=is not for this")
    give(page, guarded.token)
    page.wait_for_selector("#work:not([hidden])")
    assert page.locator("dialog").count() == 0
    page.click("#save")
    page.wait_for_selector("#saved:not([hidden])")
    assert "Authorization: Bearer $UNBEND_TOKEN" in page.text_content("#curl")
    assert guarded.token not in page.content()
    with page.expect_download():
        page.click("#exports button >> nth=0")
    with page.expect_download():
        page.click("#download")


def test_whoever_has_no_token_is_told_so(guarded: Guarded, visit: Visit) -> None:
    page = visit(guarded.address)
    page.set_input_files("#file", FACADE)
    page.wait_for_selector("dialog.token")
    page.keyboard.press("Escape")
    page.wait_for_selector("#error:not([hidden])")
    assert "token" in page.inner_text("#error")
