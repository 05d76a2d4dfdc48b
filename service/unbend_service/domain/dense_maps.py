"""Maps of every pixel, as other programs take them."""

from __future__ import annotations

import numpy as np

from unbend_service.domain.errors import InvalidGrid, InvalidOption
from unbend_service.domain.grid import MAX_SOURCE, Float32, Grid
from unbend_service.domain.inversion import InverseMap
from unbend_service.domain.maps import BackwardMap, Float64, pixel_centres

#: Most pixels of a dense map: 8K UHD and a little more, 256 MiB of floats.
MAX_MAP_PIXELS = 1 << 25
_BAND_PIXELS = 1 << 18


def pixel_maps(backward: BackwardMap, width: int, height: int) -> tuple[Float32, Float32]:
    """The maps that ``cv2.remap`` takes, of a grid or of any backward map.

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
    rows = max(1, _BAND_PIXELS // width)
    for top in range(0, height, rows):
        band = slice(top, min(top + rows, height))
        points = backward(np.stack(np.meshgrid(s, t[band]), axis=-1))
        map_x[band] = (points[..., 0] + 1) / 2 * width - 0.5
        map_y[band] = (points[..., 1] + 1) / 2 * height - 0.5
    return map_x, map_y


def inverse_pixel_maps(grid: Grid, width: int, height: int) -> tuple[Float32, Float32]:
    """As :func:`pixel_maps`, of the redistortion: exact at every pixel. Raises FoldedGrid too."""
    return pixel_maps(InverseMap(grid), width, height)


class PixelMap:
    """A backward map given at every pixel; as a callable, bilinear between pixel centres and straight on beyond them.

    Args:
        map_x, map_y: (height, width) float, source pixels of each target pixel, centres at whole numbers.
        source_width, source_height: pixels of the source; those of the maps if left out.

    Raises:
        InvalidGrid: shapes that do not match, fewer than 2x2 pixels, or numbers that are not finite.
    """

    def __init__(
        self, map_x: Float32, map_y: Float32, source_width: int | None = None, source_height: int | None = None
    ) -> None:
        if map_x.ndim != 2 or map_x.shape != map_y.shape or min(map_x.shape) < 2:
            raise InvalidGrid(
                f"Maps of shapes {map_x.shape} and {map_y.shape}.", allowed="two (height, width) maps of one size"
            )
        if map_x.size > MAX_MAP_PIXELS:
            raise InvalidGrid(f"A map of {map_x.size} pixels.", allowed=f"{MAX_MAP_PIXELS} pixels")
        if not (np.isfinite(map_x).all() and np.isfinite(map_y).all()):
            raise InvalidGrid("The map has a number that is not finite.", allowed="finite numbers at every pixel")
        self._height, self._width = map_x.shape
        self._source = source_width or self._width, source_height or self._height
        self._maps = map_x, map_y

    @property
    def maps(self) -> tuple[Float32, Float32]:
        """map_x and map_y."""
        return self._maps

    def __call__(self, target: Float64) -> Float64:
        """(..., 2) float64 centred target points -> (..., 2) float64 centred source points."""
        column = (target[..., 0] + 1) / 2 * self._width - 0.5
        row = (target[..., 1] + 1) / 2 * self._height - 0.5
        c = np.clip(column, 0, self._width - 2).astype(np.intp)
        r = np.clip(row, 0, self._height - 2).astype(np.intp)
        u, v = column - c, row - r
        out = np.empty(target.shape)
        for axis, (samples, length) in enumerate(zip(self._maps, self._source, strict=True)):
            top = samples[r, c].astype(np.float64) * (1 - u) + samples[r, c + 1] * u
            bottom = samples[r + 1, c].astype(np.float64) * (1 - u) + samples[r + 1, c + 1] * u
            out[..., axis] = (top * (1 - v) + bottom * v + 0.5) / length * 2 - 1
        return np.clip(out, -MAX_SOURCE, MAX_SOURCE)
