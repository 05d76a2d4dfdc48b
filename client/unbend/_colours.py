"""Raw frames as RGB, for eyes: numpy alone."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Bytes = npt.NDArray[np.uint8]


def read_rgb(image: Bytes, pixel_format: str, width: int, height: int) -> Bytes:
    """The colours of a raw frame; alpha is shown over white, i420 and nv12 are read as BT.601, limited range.

    Args:
        image: uint8, any shape that holds the bytes of the frame.
        pixel_format: gray8, rgb24, bgr24, rgba, bgra, i420 or nv12.

    Returns:
        (height, width, 3) uint8.
    """
    flat = np.asarray(image, dtype=np.uint8).reshape(-1)
    if pixel_format == "gray8":
        return np.repeat(flat.reshape(height, width, 1), 3, axis=2)
    if pixel_format in ("i420", "nv12"):
        return _read_chroma(flat, pixel_format, width, height)
    pixels = flat.reshape(height, width, -1)
    colours = pixels[..., 2::-1] if pixel_format.startswith("bgr") else pixels[..., :3]
    if pixels.shape[2] == 3:
        return np.ascontiguousarray(colours)
    alpha = pixels[..., 3:].astype(np.uint16)
    return np.asarray((colours * alpha + 255 * (255 - alpha) + 127) // 255, dtype=np.uint8)


def _read_chroma(flat: Bytes, pixel_format: str, width: int, height: int) -> Bytes:
    wide, high = (width + 1) // 2, (height + 1) // 2
    luma = flat[: width * height].reshape(height, width).astype(np.float32)
    rest = flat[width * height :]
    if pixel_format == "nv12":
        blue, red = rest.reshape(high, wide, 2).transpose(2, 0, 1)
    else:
        blue, red = rest.reshape(2, high, wide)
    u, v = (np.repeat(np.repeat(plane, 2, 0), 2, 1)[:height, :width] - np.float32(128) for plane in (blue, red))
    bright = (luma - 16) * np.float32(255 / 219)
    rgb = np.stack([bright + 1.596 * v, bright - 0.392 * u - 0.813 * v, bright + 2.017 * u], axis=-1)
    return np.asarray(rgb.round().clip(0, 255), dtype=np.uint8)
