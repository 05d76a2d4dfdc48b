from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.e2e.axe import violations
from tests.e2e.conftest import ROOT, shoot
from training.annotations import read_annotation, read_annotations

PICTURE = ROOT / "service/unbend_service/web/samples/shopfront.jpg"
#: The four curves that are laid: rows y(x), columns x(y).
ROWS = ((-0.6, 0.02, 0.1, 0.01), (0.55, -0.01, -0.08, 0.0))
COLUMNS = ((-0.5, 0.0, 0.07, 0.02), (0.6, 0.03, -0.05, 0.0))


@dataclass
class Annotating:
    """A running ``unbend annotate``."""

    folder: Path
    address: str


@pytest.fixture
def annotating(tmp_path: Path) -> Iterator[Annotating]:
    sizes = ((960, 640), (640, 960), (720, 480), (480, 480), (960, 540))
    picture = cv2.imread(str(PICTURE))
    for number, size in enumerate(sizes):
        cv2.imwrite(str(tmp_path / f"{number} front & back.jpg"), cv2.resize(picture, size))
    process = subprocess.Popen(
        [sys.executable, "-m", "unbend", "annotate", str(tmp_path), "--no-open"], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    kill = threading.Timer(60, process.kill)
    kill.start()
    line = process.stdout.readline()
    kill.cancel()
    assert "5 photographs" in line, line
    yield Annotating(tmp_path, next(word for word in line.split() if word.startswith("http://127.0.0.1:")))
    process.terminate()
    process.wait(20)
    process.stdout.close()


def click(page: Any, x: float, y: float) -> None:
    box = page.locator("#board").bounding_box()
    page.mouse.click(box["x"] + (x + 1) / 2 * box["width"], box["y"] + (y + 1) / 2 * box["height"])


def lay_curves(page: Any) -> None:
    for number, (curves, upright) in enumerate(((ROWS, False), (COLUMNS, True))):
        for index, curve in enumerate(curves):
            page.keyboard.press(str(2 * number + index + 1))
            for along in (-0.85, -0.4, 0.0, 0.45, 0.85):
                across = float(np.polynomial.polynomial.polyval(along, curve))
                click(page, *((across, along) if upright else (along, across)))


def opened(page: Any, name: str) -> None:
    page.wait_for_selector(f"body[data-picture='{name}']")


def test_five_pictures_are_annotated_and_training_reads_them(annotating: Annotating, visit: Callable[..., Any]) -> None:
    """What a person clicks is what training gets, whatever the shape of the picture; a second sitting goes on."""
    page = visit(annotating.address)
    names = sorted(path.name for path in annotating.folder.glob("*.jpg"))
    for done, name in enumerate(names[:3]):
        opened(page, name)
        lay_curves(page)
        page.wait_for_selector(f"#done-text:text-is('{done + 1} of 5 done')")
        if done == 0:
            shoot(page, "annotate-1440-light")
            assert violations(page) == []
        page.keyboard.press("n")
    opened(page, names[3])

    page = visit(annotating.address, 768, 1024, "dark")
    opened(page, names[3])
    assert page.inner_text("#done-text") == "3 of 5 done"
    lay_curves(page)
    page.keyboard.press("n")
    opened(page, names[4])
    lay_curves(page)
    page.wait_for_selector("#done-text:text-is('5 of 5 done')")
    shoot(page, "annotate-768-dark")
    assert violations(page) == []

    annotations = list(read_annotations(annotating.folder))
    assert [one.picture.name for one in annotations] == names
    for one in annotations:
        height, width = cv2.imread(str(one.picture)).shape[:2]
        assert (one.width, one.height) == (width, height)
        assert np.abs(one.guides.rows.coefficients - ROWS).max() < 0.02
        assert np.abs(one.guides.columns.coefficients - COLUMNS).max() < 0.02
        assert one.residual < 0.004


def test_points_are_moved_undone_and_deleted_and_all_of_it_by_keys(
    annotating: Annotating, visit: Callable[..., Any]
) -> None:
    """A slip costs one key; nobody needs a pointer."""
    page = visit(annotating.address)
    name = min(path.name for path in annotating.folder.glob("*.jpg"))
    opened(page, name)

    def kept() -> list[list[float]]:
        page.wait_for_selector("#place:text('saved')")
        stored = json.loads((annotating.folder / f"{name}.unbend.json").read_bytes())
        return list(stored["rows"][1]["points"])

    page.keyboard.press("2")
    for x in (-0.5, 0.0, 0.5):
        click(page, x, 0.4)
    assert len(kept()) == 3
    box = page.locator("#board").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + 0.7 * box["height"]
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x, y + 0.1 * box["height"], steps=3)
    page.mouse.up()
    points = kept()
    assert len(points) == 3
    assert points[1] == pytest.approx([0, 0.6], abs=0.01)
    page.keyboard.press("Backspace")
    assert len(kept()) == 2
    page.keyboard.press("z")
    assert len(kept()) == 3
    for _ in range(3):
        page.keyboard.press("Shift+ArrowRight")
    page.keyboard.press("ArrowDown")
    page.keyboard.press("Space")
    assert len(kept()) == 4
    assert kept()[3] == pytest.approx([2 * 60 / box["width"], 2 * 2 / box["height"]], abs=0.005)
    with pytest.raises(Exception, match="not complete"):
        read_annotation(annotating.folder / f"{name}.unbend.json")
