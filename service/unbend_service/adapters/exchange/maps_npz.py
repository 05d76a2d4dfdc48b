"""OpenCV's maps in a numpy archive.

``npz`` holds ``map_x`` and ``map_y``, (height, width) float32 (CV_32FC1); ``npz-fixed`` holds ``map_1``,
(height, width, 2) int16 (CV_16SC2) and ``map_2``, (height, width) uint16 (CV_16UC1), with five bits after the point.
Both count source pixels, centres at whole numbers, and go into ``cv2.remap`` as they are.
"""

from __future__ import annotations

import io
import zipfile

import cv2
import numpy as np

from unbend_service.domain.dense_maps import MAX_MAP_PIXELS, PixelMap
from unbend_service.domain.errors import InvalidGrid, InvalidOption
from unbend_service.domain.exchange import DenseMap

#: What int16 can address.
_FIXED_SIDE_PX = 1 << 15
_INTER_BITS = 5
_PAIRS = (("map_x", "map_y"), ("map_1", "map_2"))


def write_float(dense: DenseMap) -> bytes:
    """``map_x`` and ``map_y``."""
    out = io.BytesIO()
    np.savez(out, map_x=dense.map_x, map_y=dense.map_y)
    return out.getvalue()


def write_fixed(dense: DenseMap) -> bytes:
    """``map_1`` and ``map_2``. Raises InvalidOption for sides that int16 does not address."""
    if max(dense.width, dense.height) >= _FIXED_SIDE_PX:
        raise InvalidOption("The picture is too large for fixed point.", allowed=f"sides below {_FIXED_SIDE_PX} pixels")
    far = float(_FIXED_SIDE_PX - 2)
    map_x, map_y = np.clip(dense.map_x, -far, far), np.clip(dense.map_y, -far, far)
    map_1, map_2 = cv2.convertMaps(map_x, map_y, cv2.CV_16SC2)
    out = io.BytesIO()
    np.savez(out, map_1=map_1, map_2=map_2)
    return out.getvalue()


def read(body: bytes) -> PixelMap:
    """Either kind; the source has the size of the maps.

    Raises:
        InvalidGrid: no archive, not these arrays, or too many pixels.
    """
    try:
        with np.load(io.BytesIO(body), allow_pickle=False) as archive:
            names = next((pair for pair in _PAIRS if set(pair) <= set(archive.files)), None)
            if names is None:
                raise InvalidGrid("The archive has no maps.", allowed="map_x and map_y, or map_1 and map_2")
            announced = [_pixels(archive.zip, name) for name in names]
            if max(announced) > 2 * MAX_MAP_PIXELS:
                raise InvalidGrid("The maps are too large.", allowed=f"{MAX_MAP_PIXELS} pixels")
            first, second = (np.asarray(archive[name]) for name in names)
    except InvalidGrid:
        raise
    except (OSError, ValueError, TypeError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise InvalidGrid("The file is not a numpy archive.", allowed=".npz without pickled objects") from error
    if names == ("map_1", "map_2"):
        if first.ndim != 3 or first.shape[2] != 2 or second.shape != first.shape[:2]:
            raise InvalidGrid("The fixed-point maps do not match.", allowed="(h, w, 2) int16 and (h, w) uint16")
        fraction = second.astype(np.int64)
        scale = 1 << _INTER_BITS
        map_x = first[..., 0].astype(np.float64) + (fraction & (scale - 1)) / scale
        map_y = first[..., 1].astype(np.float64) + (fraction >> _INTER_BITS & (scale - 1)) / scale
    elif first.dtype.kind not in "fiu" or second.dtype.kind not in "fiu":
        raise InvalidGrid("The maps are not numbers.")
    else:
        map_x, map_y = first, second
    return PixelMap(map_x.astype(np.float32), map_y.astype(np.float32))


def _pixels(archive: zipfile.ZipFile, name: str) -> int:
    """Elements that the header of an array announces, read before the array is."""
    with archive.open(f"{name}.npy") as member:
        version = np.lib.format.read_magic(member)
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, _ = read_header(member)
    return int(np.prod(shape, dtype=object))
