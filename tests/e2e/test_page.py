from __future__ import annotations

import json
import re
import subprocess
import sys
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.acceptance.conftest import Server
from tests.e2e.conftest import ROOT, Pixels, decoded, difference, pixels_of, shoot

FACADE = ROOT / "service/unbend_service/web/samples/facade.jpg"
#: Rounding of two bilinear samplers, in levels of 255.
SAME = 0.7

Visit = Callable[..., Any]


@pytest.fixture
def facade(tmp_path: Path) -> Path:
    """A bent facade as a PNG: two decoders give the same pixels of it."""
    path = tmp_path / "facade.png"
    cv2.imwrite(str(path), cv2.imread(str(FACADE)))
    return path


def open_picture(page: Any, path: Path) -> None:
    page.set_input_files("#file", path)
    page.wait_for_selector("#work:not([hidden])")
    settle(page)


def settle(page: Any) -> None:
    """Two frames: whatever was asked for is drawn."""
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")


def set_range(page: Any, name: str, value: float) -> None:
    page.fill(f"#{name}", str(value))
    settle(page)


def post(service: Server, path: str, body: bytes) -> bytes:
    request = urllib.request.Request(f"http://{service.http}{path}", data=body, method="POST")
    with urllib.request.urlopen(request, timeout=30) as answer:
        return bytes(answer.read())


def corrected(service: Server, path: Path, query: str = "") -> Pixels:
    return decoded(post(service, f"/v1/correct?format=png{query}", path.read_bytes()))


def drag_guide(page: Any, by: tuple[int, int] = (0, 40)) -> None:
    box = page.locator("#editor [data-point='1'] .dot").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + by[0], y + by[1], steps=4)
    page.mouse.up()
    settle(page)


def test_a_bent_picture_is_straightened_compared_adjusted_saved_and_taken_away(
    service: Server, visit: Visit, facade: Path
) -> None:
    """The whole way of somebody who has never heard of guides or grids; what is seen is what is downloaded."""
    page = visit(f"http://{service.http}/")
    open_picture(page, facade)
    assert page.inner_text("#verdict") == "Straightened"
    assert difference(pixels_of(page, "before"), decoded(facade.read_bytes())) < 0.1
    assert difference(pixels_of(page, "after"), corrected(service, facade)) < SAME
    assert difference(pixels_of(page, "after"), pixels_of(page, "before")) > 5

    box = page.locator("#viewer").bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 4, box["y"] + box["height"] / 2, steps=3)
    page.mouse.up()
    assert float(page.input_value("#split")) == pytest.approx(25, abs=1)

    for overlay in ("guides", "grid", "arrows"):
        button = page.locator(f"[data-overlay={overlay}]")
        button.click()
        settle(page)
        assert button.get_attribute("aria-pressed") == "true"
        for side in ("over-before", "over-after"):
            assert page.locator(f"#{side} path").count() > 4
        button.click()
    settle(page)
    assert page.locator("#over-after path").count() == 0

    set_range(page, "strength", 60)
    set_range(page, "fit", 40)
    assert difference(pixels_of(page, "after"), corrected(service, facade, "&strength=0.6&fit=0.4")) < SAME

    page.check("#keep")
    settle(page)
    assert difference(pixels_of(page, "after"), corrected(service, facade, "&strength=0.6&fit=keep")) < SAME
    page.uncheck("#keep")
    set_range(page, "strength", 100)
    set_range(page, "fit", 0)

    page.click("#adjust")
    settle(page)
    untouched = pixels_of(page, "after")
    drag_guide(page)
    assert page.inner_text("#verdict") == "Straightened by hand"
    by_hand = pixels_of(page, "after")
    assert difference(by_hand, untouched) > 1
    page.click("#undo")
    settle(page)
    assert difference(pixels_of(page, "after"), untouched) == 0
    drag_guide(page)
    assert difference(pixels_of(page, "after"), by_hand) < 0.5

    page.click("#save")
    page.wait_for_selector("#saved:not([hidden])")
    grid_id = page.inner_text("#grid-id")
    assert grid_id in page.text_content("#curl")
    assert grid_id in page.text_content("#python")
    by_hand = pixels_of(page, "after")
    assert difference(by_hand, corrected(service, facade, f"&grid_id={grid_id}")) < SAME
    with page.expect_download() as download:
        page.click("#download")
    assert download.value.suggested_filename == "facade-straight.png"
    assert difference(by_hand, decoded(Path(download.value.path()).read_bytes())) < SAME

    with page.expect_download() as download:
        page.click("#exports button:text-is('OpenCV maps')")
    with np.load(download.value.path()) as maps:
        straight = cv2.remap(decoded(facade.read_bytes()), maps["map_x"], maps["map_y"], cv2.INTER_LINEAR)
    assert difference(by_hand, straight) < SAME


def test_perspective_is_undone_where_that_is_asked_for(service: Server, visit: Visit, facade: Path) -> None:
    """What the page spins itself is what the service spins with correct=all."""
    page = visit(f"http://{service.http}/")
    open_picture(page, facade)
    page.check("#all")
    settle(page)
    assert difference(pixels_of(page, "after"), corrected(service, facade, "&correct=all")) < SAME


def test_the_snippets_of_a_saved_grid_give_the_previewed_picture(
    service: Server, visit: Visit, facade: Path, tmp_path: Path
) -> None:
    """Strength is in the grid and the frame in the command: whoever copies either gets what was seen."""
    page = visit(f"http://{service.http}/")
    open_picture(page, facade)
    page.check("#all")
    set_range(page, "strength", 70)
    set_range(page, "fit", 30)
    page.click("#save")
    page.wait_for_selector("#saved:not([hidden])")
    preview = pixels_of(page, "after")
    commands = {
        "curl": ["bash", "-euc", page.text_content("#curl").replace(".jpg", ".png")],
        "python": [
            sys.executable,
            "-c",
            page.text_content("#python").replace("127.0.0.1:50051", service.grpc).replace(".jpg", ".png"),
        ],
    }
    (tmp_path / "photo.png").write_bytes(facade.read_bytes())
    for name, command in commands.items():
        subprocess.run(command, cwd=tmp_path, check=True, timeout=60)
        assert difference(preview, decoded((tmp_path / "straight.png").read_bytes())) < SAME, name
        (tmp_path / "straight.png").unlink()


def test_the_preview_needs_no_webgl(service: Server, visit: Visit, facade: Path) -> None:
    """Where a browser or a driver has none the processor draws the same picture."""
    page = visit(
        f"http://{service.http}/",
        before="""const get = HTMLCanvasElement.prototype.getContext;
        HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
          return kind.startsWith("webgl") ? null : get.call(this, kind, ...rest);
        };""",
    )
    open_picture(page, facade)
    set_range(page, "fit", 50)
    assert difference(pixels_of(page, "after"), corrected(service, facade, "&fit=0.5")) < SAME


def test_a_large_picture_is_previewed_small_and_downloaded_whole(service: Server, visit: Visit, tmp_path: Path) -> None:
    """Nothing that is taken away has the size of the preview."""
    large = tmp_path / "large.jpg"
    cv2.imwrite(str(large), cv2.resize(cv2.imread(str(FACADE)), (2400, 1600)))
    page = visit(f"http://{service.http}/")
    open_picture(page, large)
    assert pixels_of(page, "after").shape[:2] == (1067, 1600)
    with page.expect_download() as download:
        page.click("#download")
    assert decoded(Path(download.value.path()).read_bytes()).shape[:2] == (1600, 2400)


def test_a_picture_that_was_left_alone_says_so_and_why(service: Server, visit: Visit, facade: Path) -> None:
    """Nobody wonders why nothing happened; who knows better may insist."""
    page = visit(f"http://{service.http}/")
    page.route("**/v1/estimate", lambda route: route.continue_(url=f"{route.request.url}?min_confidence=1"))
    open_picture(page, facade)
    assert page.inner_text("#verdict") == "Left as it is"
    assert re.search(r"is \d+\s% sure that a correction would make this picture better", page.inner_text("#why"))
    assert difference(pixels_of(page, "after"), pixels_of(page, "before")) < 0.1
    assert page.is_hidden("#save")
    with page.expect_download() as download:
        page.click("#download")
    assert Path(download.value.path()).read_bytes() == facade.read_bytes()
    shoot(page, "left-alone")
    page.click("#anyway")
    settle(page)
    assert difference(pixels_of(page, "after"), corrected(service, facade)) < SAME


def test_a_doubtful_correction_says_how_much_of_it_is_applied(service: Server, visit: Visit, facade: Path) -> None:
    """The grid is drawn as it came; who knows better may have all of it."""
    page = visit(f"http://{service.http}/")
    record = json.loads(post(service, "/v1/estimate?min_confidence=0&strength=0.25", facade.read_bytes()))
    doubted = record | {"reason": "low_confidence", "confidence": 0.4}
    page.route("**/v1/estimate", lambda route: route.fulfill(json=doubted))
    open_picture(page, facade)
    assert page.inner_text("#verdict") == "Straightened a little"
    assert re.search(r"is 40\s% sure .* In doubt only 25\s% of the correction is applied", page.inner_text("#why"))
    assert difference(pixels_of(page, "after"), corrected(service, facade, "&strength=0.25")) < SAME
    assert page.inner_text("#anyway") == "Correct it all the way"
    shoot(page, "doubtful")
    page.click("#anyway")
    settle(page)
    assert re.search(r"would have applied 25\s% of it", page.inner_text("#why"))
    assert difference(pixels_of(page, "after"), corrected(service, facade)) < SAME


def test_a_file_that_is_no_picture_is_refused_with_a_sentence(
    service: Server, visit: Visit, facade: Path, tmp_path: Path
) -> None:
    """The sentence is the service's own, and the next picture is welcome."""
    text = tmp_path / "notes.txt"
    text.write_text("not a picture")
    page = visit(f"http://{service.http}/")
    page.set_input_files("#file", text)
    page.wait_for_selector("#error:not([hidden])")
    sentence = page.inner_text("#error")
    assert sentence.startswith("notes.txt is not an image")
    assert sentence.endswith(".")
    assert "jpeg" in sentence
    shoot(page, "refused")
    open_picture(page, facade)
    assert page.is_hidden("#error")
    page.set_input_files("#file", text)
    page.wait_for_selector("#refused:not([hidden])")
    assert page.is_visible("#work"), "the picture at work stays"


def test_everything_can_be_done_from_the_keyboard(service: Server, visit: Visit) -> None:
    """From the sample to the saved grid without a pointer; the focus is never lost."""
    page = visit(f"http://{service.http}/")

    def tab_to(selector: str, most: int = 40) -> None:
        for _ in range(most):
            page.keyboard.press("Tab")
            if page.evaluate("selector => document.activeElement.matches(selector)", selector):
                return
        raise AssertionError(f"{selector} is not reached")

    tab_to("[data-sample='facade.jpg']")
    page.keyboard.press("Enter")
    page.wait_for_selector("#work:not([hidden])")
    settle(page)
    tab_to("#split")
    page.keyboard.press("ArrowRight")
    assert float(page.input_value("#split")) == 50.5
    tab_to("#strength")
    page.keyboard.press("ArrowLeft")
    settle(page)
    assert page.inner_text("#strength-value") == "99 %"
    tab_to("[data-overlay=grid]")
    page.keyboard.press("Space")
    settle(page)
    assert page.locator("#over-before path").count() > 4
    tab_to("#adjust")
    page.keyboard.press("Enter")
    settle(page)
    tab_to("#guide-next")
    page.keyboard.press("Enter")
    settle(page)
    assert page.inner_text("#guide-name").startswith("Row 2 of")
    tab_to("[data-point='0']")
    before = page.get_attribute("[data-point='0']", "aria-valuetext")
    page.keyboard.press("Shift+ArrowDown")
    settle(page)
    assert page.evaluate("document.activeElement.dataset.point") == "0"
    pixels = [float(text.split()[0]) for text in (before, page.get_attribute("[data-point='0']", "aria-valuetext"))]
    assert pixels[1] - pixels[0] == pytest.approx(10, abs=0.2)
    page.keyboard.press("Control+z")
    settle(page)
    assert page.get_attribute("[data-point='0']", "aria-valuetext") == before
    page.keyboard.press("Escape")
    settle(page)
    settle(page)
    assert page.evaluate("document.activeElement.id") == "adjust"
    tab_to("#save")
    page.keyboard.press("Enter")
    page.wait_for_selector("#saved:not([hidden])")
    assert re.fullmatch("g[0-9a-f]{32}", page.inner_text("#grid-id"))


def test_guides_that_fold_the_picture_are_refused_at_once(service: Server, visit: Visit, facade: Path) -> None:
    """The last grid that was sound stays in sight, and nothing folded can be saved."""
    page = visit(f"http://{service.http}/")
    open_picture(page, facade)
    page.click("#adjust")
    settle(page)
    drag_guide(page, (0, 500))
    assert "fold" in page.inner_text("#fold") or "of the correction is applied" in page.inner_text("#why")
    page.click("#reset")
    settle(page)
    assert page.is_hidden("#fold")
    assert difference(pixels_of(page, "after"), corrected(service, facade)) < SAME


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1440, 768, 390])
def test_the_page_fits_every_screen(service: Server, visit: Visit, width: int, scheme: str) -> None:
    """Nothing runs out at the side; screenshots for people are kept."""
    page = visit(f"http://{service.http}/", width, {1440: 900, 768: 1024, 390: 844}[width], scheme)

    def fits(name: str) -> None:
        settle(page)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        shoot(page, f"{name}-{width}-{scheme}")

    fits("welcome")
    page.click("[data-sample='shopfront.jpg']")
    page.wait_for_selector("#work:not([hidden])")
    fits("compare")
    page.click("[data-overlay=guides]")
    page.evaluate("scrollTo(0, 0)")
    fits("guides")
    page.click("#adjust")
    page.evaluate("scrollTo(0, 0)")
    fits("adjust")


def test_the_page_computes_what_the_domain_computes(service: Server, visit: Visit) -> None:
    """Guides to grid, strength and fit are written twice, in Python and for the browser; they must not drift apart."""
    from unbend_service.domain.decision import spin_grid
    from unbend_service.domain.fit import Fit, with_fit, with_strength
    from unbend_service.domain.guides import Guides
    from unbend_service.domain.records import Correct

    page = visit(f"http://{service.http}/")
    spun = """async ([guides, correct, strength, zooms]) => {
        const { spin } = await import("/web/geometry/spin.js");
        const { withFit, withStrength } = await import("/web/geometry/fit.js");
        const blended = withStrength(spin(guides, correct, 65), strength);
        return zooms.map((zoom) => Array.from(withFit(blended, zoom).lattice.source));
    }"""
    rng = np.random.default_rng(7)
    for count, degree, bend in ((2, 3, 0.2), (4, 3, -0.12), (6, 5, 0.12)):
        value = Guides.straight(np.linspace(-0.9, 0.9, count), degree).to_dict()
        for family, tilt in (("rows", 0.04), ("columns", -0.04)):
            for guide in value[family]:
                guide["coefficients"][0] += rng.normal() * 0.004
                guide["coefficients"][1] += tilt
                guide["coefficients"][2] += bend * guide["anchor"] / 2
        for correct, strength in ((Correct.NONLINEAR, 1.0), (Correct.ALL, 0.7)):
            blended = with_strength(spin_grid(Guides.from_dict(value), correct), strength)
            assert blended.is_unfolded
            found = page.evaluate(spun, [json.loads(json.dumps(value)), correct.value, strength, [None, 0, 1, 0.4]])
            for fit, source in zip(("keep", "crop", "full", "0.4"), found, strict=True):
                expected = with_fit(blended, Fit.parse(fit)).source.ravel()
                assert np.abs(np.array(source) - expected).max() < 2e-5, (count, correct, strength, fit)
