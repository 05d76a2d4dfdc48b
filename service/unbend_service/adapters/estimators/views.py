"""The view of a picture that the picture branch of an estimator looks at, and what its front end makes of it."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

VIEW_PX = 192


def view_of(grey: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    """The whole picture in the middle of a square, nothing squashed: the square is the isotropic frame.

    Args:
        grey: (height, width) uint8.

    Returns:
        (VIEW_PX, VIEW_PX) float32 in [0, 1]; beside the picture its mean.
    """
    height, width = grey.shape
    scale = VIEW_PX / max(height, width)
    columns, rows = max(1, round(width * scale)), max(1, round(height * scale))
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    small = np.asarray(cv2.resize(grey, (columns, rows), interpolation=interpolation), np.float32) / np.float32(255)
    if columns == rows:
        return small
    view = np.full((VIEW_PX, VIEW_PX), small.mean(), np.float32)
    left, top = (VIEW_PX - columns) // 2, (VIEW_PX - rows) // 2
    view[top : top + rows, left : left + columns] = small
    return view


def mirrored_maps(maps: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """What the front end would make of the mirror image, x -> -x.

    Args:
        maps: (n, 2 + 2 harmonics, rows, columns) float32: intensity, edge strength, then cosine and sine of each
            harmonic of the gradient's direction, as `training.picture_network.OrientationFront` orders them.

    Returns:
        The same shape. A mirror turns the direction theta into pi - theta, and 2 k theta into -2 k theta.
    """
    reflected = np.ascontiguousarray(maps[..., ::-1])
    reflected[:, 3::2] *= -1
    return reflected
