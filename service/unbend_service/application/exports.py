"""Grids in the forms that other programs read."""

from __future__ import annotations

import io

import numpy as np

from unbend_service.domain.errors import InvalidOption
from unbend_service.domain.grid import Float32, Grid
from unbend_service.domain.maps import pixel_centres

#: Most pixels of an exported map: 8K UHD and a little more, 256 MiB of floats.
MAX_MAP_PIXELS = 1 << 25
_BAND_ROWS = 256


def opencv_maps(grid: Grid, width: int, height: int) -> tuple[Float32, Float32]:
    """The maps that ``cv2.remap`` takes.

    Returns:
        map_x, map_y: (height, width) float32, source pixels of each target pixel, centres at whole numbers as OpenCV
        counts: px = (x + 1) / 2 width - 0.5.

    Raises:
        InvalidOption: a size outside 1..MAX_MAP_PIXELS.
    """
    if width < 1 or height < 1 or width * height > MAX_MAP_PIXELS:
        raise InvalidOption(
            f"A map of {width}x{height} pixels is not exported.", allowed=f"1 to {MAX_MAP_PIXELS} pixels in all"
        )
    map_x = np.empty((height, width), np.float32)
    map_y = np.empty((height, width), np.float32)
    s, t = pixel_centres(width), pixel_centres(height)
    for top in range(0, height, _BAND_ROWS):
        band = slice(top, min(top + _BAND_ROWS, height))
        points = grid(np.stack(np.meshgrid(s, t[band]), axis=-1))
        map_x[band] = (points[..., 0] + 1) / 2 * width - 0.5
        map_y[band] = (points[..., 1] + 1) / 2 * height - 0.5
    return map_x, map_y


def npz_of_maps(grid: Grid, width: int, height: int) -> bytes:
    """An .npz of ``map_x`` and ``map_y``; raises as :func:`opencv_maps`."""
    map_x, map_y = opencv_maps(grid, width, height)
    out = io.BytesIO()
    np.savez(out, map_x=map_x, map_y=map_y)
    return out.getvalue()
