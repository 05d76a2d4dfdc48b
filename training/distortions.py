"""Lens and pose distortions for whole batches, exact in both directions.

A batch of distortions is a chain of elementary maps, the same for every sample, with parameters per sample (identity
where a sample has no such part). From the distorted picture (source) to the straight one (target):

    mirrors and transposition -> radial + tangential lens about a centre, or a wave -> homography -> mirrors back

Everything is in the isotropic frame of `unbend_service.adapters.estimators.chains`: one unit = half the long side,
y down. The LZSL19 families are stated there in pixels of a 512 frame of which the 256 crop is seen, so 1 unit = 128 px.

Lens models
    division (Fitzgibbon 2001):  r_u = r_d / (1 + l1 r_d^2 + l2 r_d^4)
    inverse polynomial:          r_u = r_d (1 + k1 r_d^2 + k2 r_d^4)
    Brown-Conrady:               r_d = r_u (1 + k1 r_u^2 + k2 r_u^4), tangential p1, p2
    fisheye (equidistant / KB4): r_d = f theta (1 + k1 theta^2 + k2 theta^4), theta = atan(r_u / f)
All have unit scale at their centre. Any of them is turned into a pair of monotone tables of radii, which is what makes
one vectorised code path serve them all.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]
Floats = npt.NDArray[Any]
"""float64 for a few points per sample, float32 for the many of all chains."""

TABLE_SIZE = 384
TABLE_REACH = 2.6
"""Radii, in isotropic units, up to which the radius tables go."""
BEYOND = 9.0
"""What a table holds past the fold of its lens, outside every picture."""


@dataclass(frozen=True)
class DistortionBatch:
    """Parameters of `size` distortions; see the module docstring for the order of the maps.

    kind: int (B,), index into random_distortions.KINDS.
    undistorted_radius, distorted_radius: float64 (B, TABLE_SIZE), at TABLE_REACH k / (TABLE_SIZE - 1): r_u of r_d and
        r_d of r_u. Past the fold of a model they hold a value outside every picture.
    centre, tangential: float64 (B, 2). wave: float64 (B, 2), magnitude and phase of x_u = x_d + m sin(pi y + phase).
    homography: float64 (B, 3, 3), lens-corrected -> target.
    mirror_x, mirror_y, transposed: bool (B,).
    """

    kind: Ints
    undistorted_radius: Float64
    distorted_radius: Float64
    centre: Float64
    tangential: Float64
    wave: Float64
    homography: Float64
    mirror_x: Bools
    mirror_y: Bools
    transposed: Bools

    @property
    def size(self) -> int:
        return len(self.kind)

    def only(self, one: int) -> DistortionBatch:
        """The batch that holds this distortion alone."""
        return DistortionBatch(**{field.name: getattr(self, field.name)[one : one + 1] for field in fields(self)})

    def straighten(self, x: Float64, y: Float64) -> tuple[Float64, Float64]:
        """Source -> target. x, y: (B, n) isotropic source coordinates; the result likewise.

        Tangential parts, which are defined in the other direction, are inverted by fixed-point iteration.
        """
        x, y = self._oriented(x, y, np.s_[:, None], before=True)
        centre_x, centre_y = self.centre[:, :1], self.centre[:, 1:]
        dx, dy = x - centre_x, y - centre_y
        scale = _scale(self.undistorted_radius, np.hypot(dx, dy))
        undistorted_x, undistorted_y = dx * scale, dy * scale
        tilted = np.flatnonzero(self.tangential.any(1))
        p1, p2 = self.tangential[tilted, :1], self.tangential[tilted, 1:]
        for _ in range(6 if len(tilted) else 0):
            shift_x, shift_y = _tangential(undistorted_x[tilted], undistorted_y[tilted], p1, p2)
            radial_x, radial_y = dx[tilted] - shift_x, dy[tilted] - shift_y
            scale = _scale(self.undistorted_radius[tilted], np.hypot(radial_x, radial_y))
            undistorted_x[tilted], undistorted_y[tilted] = radial_x * scale, radial_y * scale
        magnitude, phase = self.wave[:, :1], self.wave[:, 1:]
        x = undistorted_x + centre_x + magnitude * np.sin(np.pi * y + phase)
        y = undistorted_y + centre_y
        x, y, _ = _project(self.homography, x, y, np.s_[:, None])
        return self._oriented(x, y, np.s_[:, None], before=False)

    def bend(self, x: Float32, y: Float32, sample: Ints) -> tuple[Float32, Float32, Bools]:
        """Target -> source for flat points of any number per sample.

        x, y: float32 (n,) isotropic target coordinates. sample: int (n,). Returns source x, y and whether the point
        has an image at all (it may lie behind the camera, or past the fold of a lens).
        """
        x, y = self._oriented(x, y, sample, before=True)
        x, y, visible = _project(np.asarray(np.linalg.inv(self.homography), np.float64), x, y, sample)
        centre_x, centre_y = (self.centre[:, i].astype(np.float32)[sample] for i in (0, 1))
        dx, dy = x - centre_x, y - centre_y
        radius = np.hypot(dx, dy)
        scale = _flat_scale(self.distorted_radius, radius, sample)
        visible &= (radius < TABLE_REACH) & (scale * radius < BEYOND / 2)
        bent_x, bent_y = dx * scale, dy * scale
        if self.tangential.any():
            p1, p2 = (self.tangential[:, i].astype(np.float32)[sample] for i in (0, 1))
            shift_x, shift_y = _tangential(dx, dy, p1, p2)
            bent_x, bent_y = bent_x + shift_x, bent_y + shift_y
        magnitude, phase = (self.wave[:, i].astype(np.float32)[sample] for i in (0, 1))
        y = bent_y + centre_y
        x = bent_x + centre_x - magnitude * np.sin(np.float32(np.pi) * y + phase)
        x, y = self._oriented(x, y, sample, before=False)
        return x.astype(np.float32), y.astype(np.float32), visible

    def _oriented(self, x: Floats, y: Floats, at: Any, *, before: bool) -> tuple[Floats, Floats]:
        """The mirrors and transposition, or (before=False) their inverse."""
        sign_x = np.where(self.mirror_x, -1, 1).astype(x.dtype)[at]
        sign_y = np.where(self.mirror_y, -1, 1).astype(x.dtype)[at]
        transposed = self.transposed[at]
        if before:
            x, y = np.where(transposed, y, x), np.where(transposed, x, y)
        x, y = x * sign_x, y * sign_y
        if not before:
            x, y = np.where(transposed, y, x), np.where(transposed, x, y)
        return x, y


def _tangential(x: Floats, y: Floats, p1: Floats, p2: Floats) -> tuple[Floats, Floats]:
    """Brown (1966): dx = 2 p1 x y + p2 (r^2 + 2 x^2), dy = p1 (r^2 + 2 y^2) + 2 p2 x y; undistorted x, y."""
    square = np.minimum(x * x + y * y, 4)
    return 2 * p1 * x * y + p2 * (square + 2 * x * x), p1 * (square + 2 * y * y) + 2 * p2 * x * y


def _project(matrices: Float64, x: Floats, y: Floats, at: Any) -> tuple[Floats, Floats, Bools]:
    entries = (matrices / matrices[:, 2:, 2:]).astype(x.dtype)

    def entry(row: int, column: int) -> Floats:
        return np.asarray(entries[:, row, column][at])

    depth = entry(2, 0) * x + entry(2, 1) * y + 1
    visible = depth > 0.1
    depth = np.where(visible, depth, 1)
    projected_x = (entry(0, 0) * x + entry(0, 1) * y + entry(0, 2)) / depth
    return projected_x, (entry(1, 0) * x + entry(1, 1) * y + entry(1, 2)) / depth, visible


def _scale(table: Float64, radius: Float64) -> Float64:
    """Ratio table(radius) / radius for (B, n) radii, linear between table entries."""
    position = np.minimum(radius * ((TABLE_SIZE - 1) / TABLE_REACH), TABLE_SIZE - 1.001)
    below = position.astype(np.int64)
    row = np.arange(len(table))[:, None]
    left, right = table[row, below], table[row, below + 1]
    value = np.where(right < BEYOND, left + (position - below) * (right - left), BEYOND)
    return np.asarray(np.where(radius > 1e-6, value / np.maximum(radius, 1e-6), 1.0))


def _flat_scale(table: Float64, radius: Float32, sample: Ints) -> Float32:
    position = np.minimum(radius * np.float32((TABLE_SIZE - 1) / TABLE_REACH), np.float32(TABLE_SIZE - 1.001))
    below = position.astype(np.int64)
    flat = table.astype(np.float32).ravel()
    index = sample * TABLE_SIZE + below
    left, right = flat[index], flat[index + 1]
    value = np.where(right < BEYOND, left + (position - below.astype(np.float32)) * (right - left), BEYOND)
    return np.asarray(np.where(radius > 1e-6, value / np.maximum(radius, np.float32(1e-6)), np.float32(1)), np.float32)
