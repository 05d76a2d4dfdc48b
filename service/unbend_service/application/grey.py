"""Grey pictures for the estimator, from raw frames."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from unbend_service.application.ports import Bytes
from unbend_service.domain.frames import Frame, PixelFormat

#: ITU-R BT.601-7 luma, for channels in the order of the format.
_WEIGHTS = {
    PixelFormat.RGB24: (0.299, 0.587, 0.114),
    PixelFormat.BGR24: (0.114, 0.587, 0.299),
    PixelFormat.RGBA: (0.299, 0.587, 0.114),
    PixelFormat.BGRA: (0.114, 0.587, 0.299),
}


def grey_of_frame(frame: Frame, longest_px: int) -> Bytes:
    """Luma of a frame, reduced by a whole factor (area mean) so that the longer side is at least ``longest_px``.

    Returns:
        (height, width) uint8; never enlarged, and never reduced below ``longest_px``.
    """
    first = frame.plane_arrays()[0]
    factor = max(1, max(frame.width, frame.height) // longest_px)
    factor_y, factor_x = min(factor, frame.height), min(factor, frame.width)
    height, width = frame.height // factor_y * factor_y, frame.width // factor_x * factor_x
    cut = first[:height, :width]
    weights = _WEIGHTS.get(frame.pixel_format)
    if weights is None:
        if factor == 1:
            return np.ascontiguousarray(cut)
        return _mean(cut, factor_y, factor_x).round().astype(np.uint8)
    channels = [_mean(cut[..., i], factor_y, factor_x) * weight for i, weight in enumerate(weights)]
    return np.asarray(sum(channels)).round().astype(np.uint8)


def _mean(plane: Bytes, factor_y: int, factor_x: int) -> npt.NDArray[np.float32]:
    if factor_y == factor_x == 1:
        return plane.astype(np.float32)
    blocks = plane.reshape(plane.shape[0] // factor_y, factor_y, plane.shape[1] // factor_x, factor_x)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float32), dtype=np.float32)
