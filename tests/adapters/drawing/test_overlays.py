from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.fakes import barrel_guides
from unbend_service.adapters.drawing.figures import FigureIllustrator
from unbend_service.application.exhibit import Exhibit, Subject
from unbend_service.domain.errors import InvalidFrame
from unbend_service.domain.frames import Frame, PixelFormat, frame_size_bytes
from unbend_service.domain.grid import Grid
from unbend_service.domain.guides import Guides
from unbend_service.domain.maps import target_lattice

ILLUSTRATOR = FigureIllustrator()
PACKED = (PixelFormat.GRAY8, PixelFormat.RGB24, PixelFormat.BGR24, PixelFormat.RGBA, PixelFormat.BGRA)


def plain(value: int, width: int = 400, height: int = 300, pixel_format: PixelFormat = PixelFormat.RGB24) -> Frame:
    size = frame_size_bytes(pixel_format, width, height)
    return Frame(pixel_format, width, height, np.full(size, value, np.uint8))


def pixels(frame: Frame) -> np.ndarray[Any, Any]:
    return frame.plane_arrays()[0].astype(int)


def shifted(share: float) -> Grid:
    return Grid((target_lattice(17, 17) + np.array([share, 0])).astype(np.float32))


def guides(frame: Frame, drawn: Guides) -> Frame:
    return ILLUSTRATOR.raster(Subject.GUIDES, Exhibit(frame, Grid.identity(), drawn))


def lattice(frame: Frame, drawn: Grid) -> Frame:
    return ILLUSTRATOR.raster(Subject.GRID, Exhibit(frame, drawn))


def displacement(frame: Frame, drawn: Grid) -> Frame:
    return ILLUSTRATOR.raster(Subject.DISPLACEMENT, Exhibit(frame, drawn))


def amber(image: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    return (np.abs(image - np.array([255, 176, 0])) < 40).all(-1)


def test_guides_lie_where_the_polynomials_say() -> None:
    """A straight row guide at anchor 0.3 is drawn at 0.3 of the half height, and column guides across it."""
    drawn = amber(pixels(guides(plain(128, 800, 600), Guides.straight())))
    rows = np.nonzero(drawn.mean(axis=1) > 0.8)[0]
    expected = [(anchor + 1) / 2 * 600 - 0.5 for anchor in (-0.9, -0.3, 0.3, 0.9)]
    for y in expected:
        assert np.abs(rows - y).min() <= 1
    assert all(min(abs(row - y) for y in expected) <= 2 for row in rows)


def test_bent_guides_are_drawn_bent() -> None:
    """The top guide of a barrel is higher at its middle than at its ends."""
    drawn = amber(pixels(guides(plain(128, 800, 600), barrel_guides(0.2))))
    top = [int(np.nonzero(drawn[:, x])[0].min()) for x in (2, 410, 797)]
    assert top[0] == pytest.approx(top[2], abs=2)
    assert abs(top[1] - top[0]) > 30


@pytest.mark.parametrize("background", [0, 128, 255])
def test_lines_are_legible_on_any_background(background: int) -> None:
    """On black, grey and white alike, lines differ clearly from what lies beside them."""
    for drawn in (
        guides(plain(background), barrel_guides()),
        lattice(plain(background), Grid.from_map(barrel_guides())),
        displacement(plain(background), Grid.from_map(barrel_guides())),
    ):
        luma = pixels(drawn) @ np.array([0.299, 0.587, 0.114])
        steps = np.abs(np.diff(luma, axis=0))
        assert (steps.max(axis=0) > 60).mean() > 0.5


def test_the_lattice_is_drawn_in_the_source() -> None:
    """The rim of a grid that shows the middle half is drawn around that half."""
    half = Grid((0.5 * target_lattice(17, 17)).astype(np.float32))
    drawn = amber(pixels(lattice(plain(0, 800, 600), half)))
    ys, xs = np.nonzero(drawn)
    assert max(abs(xs.min() - 199.5), abs(xs.max() - 599.5)) <= 2
    assert max(abs(ys.min() - 149.5), abs(ys.max() - 449.5)) <= 2


def test_nothing_is_drawn_longer_than_it_is_without_saying_so() -> None:
    """A displacement too large to be exaggerated, and none at all, are drawn to scale; both leave a picture."""
    for grid in (shifted(0.5), shifted(0.0), shifted(0.001)):
        drawn = displacement(plain(200), grid)
        assert (pixels(drawn) != 200).any()


@pytest.mark.parametrize("pixel_format", PACKED)
def test_every_decoded_format_can_be_drawn_over(pixel_format: PixelFormat) -> None:
    """The picture is rgb24 of the same size, whatever it was before, and its colours are right."""
    frame = plain(255, 220, 210, pixel_format)
    frame.data.reshape(210, 220, -1)[..., 0] = 40
    drawn = guides(frame, barrel_guides())
    assert (drawn.pixel_format, drawn.width, drawn.height) == (PixelFormat.RGB24, 220, 210)
    corner = pixels(drawn)[0, 0].tolist()
    blue_first = pixel_format in (PixelFormat.BGR24, PixelFormat.BGRA)
    assert corner == (
        [40] * 3 if pixel_format is PixelFormat.GRAY8 else [255, 255, 40] if blue_first else [40, 255, 255]
    )


def test_transparency_shows_white() -> None:
    """What is transparent is drawn over white."""
    assert pixels(guides(plain(0, pixel_format=PixelFormat.RGBA), Guides.straight()))[0, 0].tolist() == [255] * 3


def test_planar_frames_are_refused() -> None:
    """Only decoded pictures are drawn over."""
    with pytest.raises(InvalidFrame):
        guides(plain(0, pixel_format=PixelFormat.I420), Guides.straight())


@pytest.mark.parametrize(("width", "height"), [(1, 1), (3, 200), (5000, 40), (201, 201), (260, 1900)])
def test_any_size_can_be_drawn_over(width: int, height: int) -> None:
    """Tiny, thin and long pictures come back at their size; the source is never written to."""
    frame = plain(90, width, height)
    frame.data.flags.writeable = False
    grid = Grid.from_map(barrel_guides())
    for drawn in (
        guides(frame, barrel_guides()),
        lattice(frame, grid),
        displacement(frame, grid),
    ):
        assert (drawn.width, drawn.height) == (width, height)
    assert (frame.data == 90).all()


def test_points_far_outside_are_harmless() -> None:
    """A grid may point far out of the picture."""
    far = Grid((16 * target_lattice(9, 9)).astype(np.float32))
    assert lattice(plain(0, 3000, 2000), far).width == 3000
    assert displacement(plain(0, 3000, 2000), far).width == 3000
