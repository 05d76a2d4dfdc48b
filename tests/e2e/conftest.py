from __future__ import annotations

import base64
import os
import shutil
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from tests.acceptance.conftest import Server, start_server, stop_server

ROOT = Path(__file__).parent.parent.parent
ARTIFACTS = ROOT / "artifacts"
CHROMIUM = os.environ.get("UNBEND_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
_FLAGS = (
    "--no-sandbox",  # the tests run as root in containers
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)
Pixels = npt.NDArray[np.uint8]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    reason = ""
    if CHROMIUM is None:
        reason = "no chromium on this machine (Debian: apt-get install chromium)"
    elif find_spec("playwright") is None:
        reason = "playwright is not installed (pip install --group e2e)"
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.e2e)
            if reason:
                item.add_marker(pytest.mark.skip(reason=reason))


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=CHROMIUM, args=list(_FLAGS))
        yield opened
        opened.close()


@pytest.fixture(scope="session")
def service() -> Iterator[Server]:
    running = start_server(workers="1", renderer="cpu")
    yield running
    assert stop_server(running) == 0


@pytest.fixture
def visit(browser: Any) -> Iterator[Callable[..., Any]]:
    """Opens a page at an address, after the script ``before`` in it.

    Afterwards it must not have logged an error or asked another host for anything.
    """
    opened: list[tuple[Any, list[str]]] = []

    def visit(address: str, width: int = 1440, height: int = 900, scheme: str = "light", before: str = "") -> Any:
        context = browser.new_context(
            viewport={"width": width, "height": height}, color_scheme=scheme, accept_downloads=True
        )
        context.set_default_timeout(15_000)
        if before:
            context.add_init_script(before)
        page, complaints = context.new_page(), []
        page.on("pageerror", lambda error: complaints.append(str(error)))
        # an answer with an error status is logged by the browser itself; the page's sentence about it is what is tested
        page.on(
            "console",
            lambda message: (
                complaints.append(message.text)
                if message.type == "error" and "Failed to load resource" not in message.text
                else None
            ),
        )
        page.on(
            "request",
            lambda request: (
                None if request.url.startswith((address, "blob:", "data:")) else complaints.append(request.url)
            ),
        )
        opened.append((context, complaints))
        page.goto(address)
        return page

    yield visit
    for context, complaints in opened:
        context.close()
        assert complaints == []


def pixels_of(page: Any, canvas: str) -> Pixels:
    """(height, width, 3) uint8 RGB, what a canvas shows."""
    url = page.evaluate("id => document.getElementById(id).toDataURL('image/png')", canvas)
    return decoded(base64.b64decode(url.split(",", 1)[1]))


def decoded(body: bytes) -> Pixels:
    """(height, width, 3) uint8 RGB."""
    picture = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    return np.asarray(picture[..., ::-1], dtype=np.uint8)


def difference(one: Pixels, other: Pixels) -> float:
    """Mean absolute difference of two pictures of the same size, in levels of 255."""
    assert one.shape == other.shape
    return float(np.abs(one.astype(np.int16) - other).mean())


def shoot(page: Any, name: str) -> None:
    """A screenshot for people, below artifacts/, which git ignores."""
    ARTIFACTS.mkdir(exist_ok=True)
    page.screenshot(path=str(ARTIFACTS / f"{name}.png"))
