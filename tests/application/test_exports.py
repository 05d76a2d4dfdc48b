from __future__ import annotations

import io

import numpy as np
import pytest

from tests.fakes import barrel_guides
from unbend_service.application.exports import MAX_MAP_PIXELS, npz_of_maps, opencv_maps
from unbend_service.domain.errors import InvalidOption
from unbend_service.domain.grid import Grid


@pytest.mark.parametrize(("width", "height"), [(7, 5), (640, 700), (1, 1)])
def test_the_identity_maps_each_pixel_to_itself(width: int, height: int) -> None:
    """OpenCV counts pixel centres from 0; so do the maps."""
    map_x, map_y = opencv_maps(Grid.identity(), width, height)
    assert map_x.shape == map_y.shape == (height, width)
    assert map_x.dtype == map_y.dtype == np.float32
    np.testing.assert_allclose(map_x, np.broadcast_to(np.arange(width), (height, width)), atol=1e-3)
    np.testing.assert_allclose(map_y, np.broadcast_to(np.arange(height)[:, None], (height, width)), atol=1e-3)


def test_maps_are_those_of_the_grid() -> None:
    """Between lattice points the maps follow the grid, also across the bands that they are computed in."""
    grid = Grid.from_map(barrel_guides())
    map_x, map_y = opencv_maps(grid, 31, 600)
    point = grid(np.array([2 * 10.5 / 31 - 1, 2 * 256.5 / 600 - 1]))
    assert map_x[256, 10] == pytest.approx((point[0] + 1) / 2 * 31 - 0.5, abs=1e-3)
    assert map_y[256, 10] == pytest.approx((point[1] + 1) / 2 * 600 - 0.5, abs=1e-3)


def test_an_npz_holds_both_maps() -> None:
    """numpy.load finds map_x and map_y."""
    with np.load(io.BytesIO(npz_of_maps(Grid.identity(), 8, 6))) as archive:
        assert sorted(archive) == ["map_x", "map_y"]


@pytest.mark.parametrize(("width", "height"), [(0, 5), (5, -1), (MAX_MAP_PIXELS, 2)])
def test_the_size_is_bounded(width: int, height: int) -> None:
    """No request makes the service allocate without bound."""
    with pytest.raises(InvalidOption):
        opencv_maps(Grid.identity(), width, height)
