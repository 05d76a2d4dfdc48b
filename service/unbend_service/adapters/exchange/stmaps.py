"""STMaps: pictures whose red and green say where each pixel comes from.

The convention of Nuke's STMap and Blender's Map UV: R = u and G = v are 32-bit floats, 0..1 over the source, u to the
right and **v up**; pixel centres lie at (i + 0.5) / width, so the identity has R = (i + 0.5) / W in column i and
G = 1 - (j + 0.5) / H in row j from the top. Values outside 0..1 lie outside the source. Blue is written as a mask: 1
where there is a source, 0 where there is none; it is not read.

EXR needs the package OpenEXR (extra ``[export]``); TIFF is written and read by OpenCV.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from unbend_service.domain.dense_maps import MAX_MAP_PIXELS, PixelMap
from unbend_service.domain.errors import InvalidGrid, Unavailable
from unbend_service.domain.exchange import DenseMap
from unbend_service.domain.grid import Float32

_EXR_MAGIC = b"\x76\x2f\x31\x01"
_TIFF_MAGICS = (b"II*\0", b"MM\0*")


def stmap_of(dense: DenseMap) -> Float32:
    """(height, width, 3) float32: u, v and the mask, rows from the top."""
    out = np.empty((dense.height, dense.width, 3), np.float32)
    out[..., 0] = (dense.map_x + 0.5) / dense.width
    out[..., 1] = 1 - (dense.map_y + 0.5) / dense.height
    out[..., 2] = ((out[..., :2] >= 0) & (out[..., :2] <= 1)).all(axis=-1)
    return out


def map_of(stmap: Float32) -> PixelMap:
    """Inverse of :func:`stmap_of`, for a source of the size of the map; (height, width, >= 2) float32."""
    height, width = stmap.shape[:2]
    if height * width > MAX_MAP_PIXELS:
        raise InvalidGrid(f"An STMap of {width}x{height} pixels.", allowed=f"{MAX_MAP_PIXELS} pixels")
    return PixelMap(stmap[..., 0] * width - np.float32(0.5), (1 - stmap[..., 1]) * height - np.float32(0.5))


def write_tiff(dense: DenseMap) -> bytes:
    """An RGB TIFF, 32-bit float, LZW."""
    encoded, body = cv2.imencode(".tiff", stmap_of(dense)[..., ::-1])
    if not encoded:
        raise InvalidGrid("The STMap could not be written as TIFF.")
    return body.tobytes()


def read_tiff(body: bytes) -> PixelMap:
    """Raises InvalidGrid unless the body is a TIFF of three or four 32-bit float channels."""
    if not body.startswith(_TIFF_MAGICS):
        raise InvalidGrid("The file is not a TIFF.")
    try:
        pixels = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise InvalidGrid("The TIFF cannot be read.") from error
    if pixels is None or pixels.dtype != np.float32 or pixels.ndim != 3:
        raise InvalidGrid("The TIFF is not an STMap.", allowed="RGB or RGBA, 32-bit float")
    return map_of(np.asarray(pixels[..., 2::-1], dtype=np.float32))


def write_exr(dense: DenseMap) -> bytes:
    """An RGB EXR, 32-bit float, ZIP. Raises Unavailable without the package OpenEXR."""
    library = _openexr()
    header = {"compression": library.ZIP_COMPRESSION, "type": library.scanlineimage}
    with tempfile.TemporaryDirectory(prefix="unbend-") as folder:  # the library writes to paths only
        path = Path(folder, "stmap.exr")
        with library.File(header, {"RGB": stmap_of(dense)}) as file:
            file.write(str(path))
        return path.read_bytes()


def read_exr(body: bytes) -> PixelMap:
    """Raises InvalidGrid unless the body is an EXR with float channels R and G; Unavailable without OpenEXR."""
    library = _openexr()
    if not body.startswith(_EXR_MAGIC):
        raise InvalidGrid("The file is not an EXR.")
    with tempfile.TemporaryDirectory(prefix="unbend-") as folder:
        path = Path(folder, "stmap.exr")
        path.write_bytes(body)
        try:
            _check_size(library, path)
            with library.File(str(path), separate_channels=True) as file:
                channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
        except InvalidGrid:
            raise
        except Exception as error:  # the library raises bare exceptions of many kinds for a broken file
            raise InvalidGrid("The EXR cannot be read.") from error
    red, green = channels.get("R"), channels.get("G")
    if red is None or green is None or red.shape != green.shape or red.dtype != np.float32:
        raise InvalidGrid("The EXR is not an STMap.", allowed="channels R and G, 32-bit float")
    return map_of(np.stack([red, np.asarray(green, np.float32)], axis=-1))


def _check_size(library: Any, path: Path) -> None:
    """The header is read before any pixel is."""
    with library.File(str(path), header_only=True) as file:
        low, high = file.header()["dataWindow"]
    width, height = (int(b) - int(a) + 1 for a, b in zip(low, high, strict=True))
    if width < 1 or height < 1 or width * height > MAX_MAP_PIXELS:
        raise InvalidGrid(f"An STMap of {width}x{height} pixels.", allowed=f"{MAX_MAP_PIXELS} pixels")


def _openexr() -> Any:
    try:
        import OpenEXR
    except ImportError as error:
        raise Unavailable("OpenEXR is not installed here.", allowed="pip install 'unbend[export]'") from error
    return OpenEXR
