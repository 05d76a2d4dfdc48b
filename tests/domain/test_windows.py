from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import assume, given
from hypothesis.extra.numpy import array_shapes, arrays
from skimage.measure import label

from tests.domain.lenses import rotation
from unbend_service.domain.grid import Grid
from unbend_service.domain.windows import Window, WindowSearch, _connected


@given(arrays(bool, array_shapes(min_dims=2, max_dims=2, max_side=12)))
def test_only_what_hangs_together_counts(mask: npt.NDArray[np.bool_]) -> None:
    """Of the shown samples those are kept that can be reached, side by side, from the one nearest to the middle."""
    assume(mask.any())
    parts = label(mask, connectivity=1)
    row, column = np.argwhere(mask)[0]
    np.testing.assert_array_equal(_connected(mask, (int(row), int(column))), parts == parts[row, column])


def test_windows_lie_between_windows() -> None:
    """The way from one window to another is straight."""
    way = Window(0.0, 0.2, 0.5).towards(Window(0.4, 0.0, 1.5), 0.25)
    assert (way.x, way.y, way.half) == pytest.approx((0.1, 0.15, 0.75))


def test_crop_lies_within_full() -> None:
    """What crop shows, full shows."""
    search = WindowSearch(Grid.from_map(rotation(20)))
    crop, full = search.crop(), search.full()
    assert abs(crop.x - full.x) + crop.half <= full.half
    assert abs(crop.y - full.y) + crop.half <= full.half
