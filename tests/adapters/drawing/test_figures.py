from __future__ import annotations

import cv2
import numpy as np
import pytest

from tests.domain.lenses import BARREL, radial
from tests.fakes import barrel_guides, draw_through
from unbend_service.adapters.drawing.figures import FigureIllustrator, figure
from unbend_service.adapters.drawing.scene import Label, Placed, Scene
from unbend_service.application.exhibit import Exhibit, Subject
from unbend_service.domain.dense_maps import pixel_maps
from unbend_service.domain.errors import InvalidOption
from unbend_service.domain.fit import CROP, with_fit
from unbend_service.domain.frames import BLACK, Frame, PixelFormat
from unbend_service.domain.grid import Grid
from unbend_service.domain.maps import target_lattice

WIDTH, HEIGHT = 480, 320
GRID = Grid.from_map(radial(BARREL))
DRAWN = with_fit(GRID, CROP)


def exhibit() -> Exhibit:
    """Smooth noise, and what the renderer makes of it."""
    noise = cv2.GaussianBlur(np.random.default_rng(1).normal(size=(HEIGHT, WIDTH, 3)), (0, 0), 4) * 500 + 128
    frame = Frame(PixelFormat.RGB24, WIDTH, HEIGHT, np.clip(noise, 0, 255).astype(np.uint8).reshape(-1))
    straight = Frame(PixelFormat.RGB24, WIDTH, HEIGHT, draw_through(frame, DRAWN, BLACK))
    return Exhibit(frame, GRID, barrel_guides(), straight, DRAWN)


def texts(scene: Scene) -> list[str]:
    found = [item.text for item in scene.items if isinstance(item, Label)]
    return found + [text for item in scene.items if isinstance(item, Placed) for text in texts(item.scene)]


@pytest.mark.parametrize("pixel_format", [PixelFormat.RGB24, PixelFormat.GRAY8, PixelFormat.RGBA, PixelFormat.BGR24])
@pytest.mark.parametrize("subject", list(Subject))
def test_every_figure_is_drawn_of_every_decoded_format(subject: Subject, pixel_format: PixelFormat) -> None:
    """As pixels of the size that the scene says, and as SVG of the same size."""
    channels = {PixelFormat.GRAY8: 1, PixelFormat.RGBA: 4}.get(pixel_format, 3)
    frame = Frame(pixel_format, 220, 210, np.full(220 * 210 * channels, 90, np.uint8))
    shown = Exhibit(frame, GRID, barrel_guides(), frame, DRAWN)
    drawn, scene = FigureIllustrator().raster(subject, shown), figure(subject, shown)
    assert (drawn.width, drawn.height) == (scene.width, scene.height)
    head = FigureIllustrator().vector(subject, shown)[:200].decode()
    assert f'width="{scene.width}" height="{scene.height}"' in head


def test_a_pair_shows_the_same_grid_twice() -> None:
    """What lies beside a crossing on the left lies beside the same crossing on the right."""
    shown = exhibit()
    left, right = (item.scene for item in figure(Subject.GRIDS, shown).items if isinstance(item, Placed))
    bent = left.items[1].families[0][0][3]  # type: ignore[union-attr]  # strokes over the picture
    regular = right.items[1].families[0][0][3]  # type: ignore[union-attr]  # as above
    source, straight = (one.plane_arrays()[0].astype(float) for one in (shown.frame, shown.straight) if one)
    for here, there in zip(bent[8:-8:8], regular[8:-8:8], strict=True):
        one = cv2.getRectSubPix(source.astype(np.float32), (1, 1), tuple(map(float, here - 0.5)))[0, 0]
        other = cv2.getRectSubPix(straight.astype(np.float32), (1, 1), tuple(map(float, there - 0.5)))[0, 0]
        assert np.abs(one - other).max() < 6


def test_the_legend_of_magnitude_ends_at_the_longest_displacement() -> None:
    """In pixels of the picture: what the numbers say is what the map does."""
    shown = exhibit()
    map_x, map_y = pixel_maps(GRID, WIDTH, HEIGHT)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    longest = float(np.percentile(np.hypot(map_x - x, map_y - y), 99.5))
    numbers = [float(text) for text in texts(figure(Subject.MAGNITUDE, shown)) if text != "px"]
    assert numbers[0] == 0
    assert numbers[-1] == pytest.approx(longest, abs=0.06)
    np.testing.assert_allclose(np.diff(numbers), longest / 5, atol=0.11)


def test_the_legend_of_arrows_tells_the_longest_and_the_mean() -> None:
    moves = (target_lattice(65, 65) - GRID.source) * np.array([WIDTH, HEIGHT]) / 2
    lengths = np.hypot(moves[..., 0], moves[..., 1])
    lines = texts(figure(Subject.DISPLACEMENT, exhibit()))
    assert f"longest {lengths.max():.1f} px, mean {lengths.mean():.1f} px" in lines


def test_a_sheet_without_guides_shows_the_displacement() -> None:
    """Maps that were imported have no guides; the sheet is whole all the same, and guides alone are refused."""
    shown = Exhibit(exhibit().frame, GRID, None, exhibit().straight, DRAWN)
    assert {"before", "after", "displacement", "grid"} <= set(texts(figure(Subject.SHEET, shown)))
    with pytest.raises(InvalidOption):
        figure(Subject.GUIDES, shown)
