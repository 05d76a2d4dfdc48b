from __future__ import annotations

import numpy as np
import pytest

from tests.fakes import barrel_guides
from unbend_service.domain.dense_maps import MAX_MAP_PIXELS, PixelMap, inverse_pixel_maps, pixel_maps
from unbend_service.domain.errors import InvalidGrid, InvalidOption
from unbend_service.domain.grid import Grid


@pytest.mark.parametrize(("width", "height"), [(7, 5), (640, 700), (1, 1)])
def test_the_identity_maps_each_pixel_to_itself(width: int, height: int) -> None:
    """OpenCV counts pixel centres from 0; so do the maps."""
    map_x, map_y = pixel_maps(Grid.identity(), width, height)
    assert map_x.shape == map_y.shape == (height, width)
    assert map_x.dtype == map_y.dtype == np.float32
    np.testing.assert_allclose(map_x, np.broadcast_to(np.arange(width), (height, width)), atol=1e-3)
    np.testing.assert_allclose(map_y, np.broadcast_to(np.arange(height)[:, None], (height, width)), atol=1e-3)


def test_maps_are_those_of_the_grid() -> None:
    """Between lattice points the maps follow the grid, also across the bands that they are computed in."""
    grid = Grid.from_map(barrel_guides())
    map_x, map_y = pixel_maps(grid, 700, 600)
    point = grid(np.array([2 * 10.5 / 700 - 1, 2 * 399.5 / 600 - 1]))
    assert map_x[399, 10] == pytest.approx((point[0] + 1) / 2 * 700 - 0.5, abs=1e-3)
    assert map_y[399, 10] == pytest.approx((point[1] + 1) / 2 * 600 - 0.5, abs=1e-3)


def test_inverse_maps_undo_maps() -> None:
    """The redistortion of a pixel's source is that pixel."""
    grid = Grid.from_map(barrel_guides())
    there, back = PixelMap(*pixel_maps(grid, 160, 120)), PixelMap(*inverse_pixel_maps(grid, 160, 120))
    points = np.random.default_rng(1).uniform(-0.6, 0.6, (500, 2))
    assert np.abs(back(there(points)) - points).max() * 80 < 0.05


def test_a_map_of_pixels_is_read_as_the_grid_it_was_written_from() -> None:
    """Up to the very corners, which lie half a pixel outside the outermost pixel centres."""
    grid = Grid.from_map(barrel_guides(), 33, 33)
    again = Grid.from_map(PixelMap(*pixel_maps(grid, 640, 480)), 33, 33)
    assert np.abs(again.source - grid.source).max() * 320 < 0.05


@pytest.mark.parametrize(("width", "height"), [(0, 5), (5, -1), (MAX_MAP_PIXELS, 2)])
def test_the_size_is_bounded(width: int, height: int) -> None:
    """No request makes the service allocate without bound."""
    with pytest.raises(InvalidOption):
        pixel_maps(Grid.identity(), width, height)


@pytest.mark.parametrize("bad", [np.full((3, 3), np.nan), np.zeros((1, 3)), np.zeros((3, 4)), np.zeros(9)])
def test_a_broken_map_is_refused(bad: np.ndarray) -> None:
    with pytest.raises(InvalidGrid):
        PixelMap(bad.astype(np.float32), np.zeros((3, 3), np.float32))
