"""Calibrated cameras as backward maps: OpenCV's pinhole and fisheye models.

Sources: OpenCV, *Camera Calibration and 3D Reconstruction* (the rational model with tangential and thin prism terms);
Kannala and Brandt, *A generic camera model and calibration method*, 2006 (the equidistant polynomial).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unbend_service.domain.errors import InvalidGrid
from unbend_service.domain.grid import MAX_SOURCE
from unbend_service.domain.maps import Float64

_PINHOLE_COUNTS = (4, 5, 8, 12, 14)


@dataclass(frozen=True)
class Camera:
    """A calibrated camera; as a callable, the backward map that ``cv2.undistort`` draws with.

    The corrected picture has the same camera matrix, so the middle keeps its place and size.

    Attributes:
        matrix: (3, 3) float64, focal lengths and principal point in pixels, pixel centres at whole numbers.
        coefficients: pinhole: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]]; fisheye: k1 k2 k3 k4.
        fisheye: whether the equidistant (KB4) model is meant.
        width, height: pixels of the pictures that it was calibrated with.

    Raises:
        InvalidGrid: numbers that make no camera, or a tilted sensor (tau).
    """

    matrix: Float64
    coefficients: tuple[float, ...]
    fisheye: bool
    width: int
    height: int

    def __post_init__(self) -> None:
        matrix = np.asarray(self.matrix, dtype=np.float64)
        if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
            raise InvalidGrid("The camera matrix is not one.", allowed="3x3, finite, focal lengths over 0")
        if not np.allclose(matrix[[1, 2, 2], [0, 0, 1]], 0) or not np.isclose(matrix[2, 2], 1):
            raise InvalidGrid("The camera matrix is not one.", allowed="[[fx, s, cx], [0, fy, cy], [0, 0, 1]]")
        counts = (4,) if self.fisheye else _PINHOLE_COUNTS
        if len(self.coefficients) not in counts or not np.isfinite(self.coefficients).all():
            raise InvalidGrid(
                f"{len(self.coefficients)} distortion coefficients.",
                allowed=f"{', '.join(map(str, counts))} finite numbers",
            )
        if any(self.coefficients[12:]):
            raise InvalidGrid("The camera has a tilted sensor (tau).", allowed="tau_x = tau_y = 0")
        if self.width < 1 or self.height < 1:
            raise InvalidGrid("The camera has no picture size.", allowed="image_width and image_height over 0")

    def __call__(self, target: Float64) -> Float64:
        """(..., 2) float64 centred target points -> (..., 2) float64 centred source points."""
        size = np.array([self.width, self.height])
        pixels = (np.asarray(target, dtype=np.float64) + 1) / 2 * size - 0.5
        fx, skew, cx = self.matrix[0]
        fy, cy = self.matrix[1, 1:]
        y = (pixels[..., 1] - cy) / fy
        x = (pixels[..., 0] - cx - skew * y) / fx
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            bent_x, bent_y = self._fisheye(x, y) if self.fisheye else self._pinhole(x, y)
            source = np.stack([fx * bent_x + skew * bent_y + cx, fy * bent_y + cy], axis=-1)
            centred = np.nan_to_num((source + 0.5) / size * 2 - 1, nan=MAX_SOURCE)
        return np.asarray(np.clip(centred, -MAX_SOURCE, MAX_SOURCE))

    def _pinhole(self, x: Float64, y: Float64) -> tuple[Float64, Float64]:
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = (*self.coefficients[:12], *([0.0] * 12))[:12]
        r2 = x * x + y * y
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + r2 * s2)
        bent_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + r2 * s4)
        return bent_x, bent_y

    def _fisheye(self, x: Float64, y: Float64) -> tuple[Float64, Float64]:
        k1, k2, k3, k4 = self.coefficients
        r = np.hypot(x, y)
        theta = np.arctan(r)
        t2 = theta * theta
        bent = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        scale = np.where(r > 1e-9, bent / np.maximum(r, 1e-9), 1.0)
        return x * scale, y * scale
