"""Random lens and pose distortions for whole batches, exact in both directions.

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

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]

KINDS = (
    "identity",
    "barrel",
    "pincushion",
    "rotation",
    "shear",
    "projective",
    "wave",
    "division",
    "polynomial",
    "brown",
    "fisheye",
    "homography",
    "mixture",
)
SHARES = (0.08, 0.085, 0.085, 0.045, 0.045, 0.055, 0.10, 0.105, 0.065, 0.095, 0.085, 0.035, 0.12)

LZSL_CENTRE = 0.5 / 128
"""LZSL19 puts its centre at pixel index 256 of 512, half a pixel from the middle of the picture."""
LZSL_CROP_CORNER = 255.0
TABLE_SIZE = 384
TABLE_REACH = 2.6
"""Radii, in isotropic units, up to which the radius tables go."""
LENS_COVERS = 1.5
"""Distorted radius that a lens must reach without a fold; a square picture's corner is at 1.41. (An equidistant
fisheye never folds, it only runs out of the table.)"""
_BEYOND = 9.0


@dataclass(frozen=True)
class DistortionBatch:
    """Parameters of `size` distortions; see the module docstring for the order of the maps.

    kind: int (B,), index into KINDS.
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
        x, y, visible = _project(np.linalg.inv(self.homography), x, y, sample)
        centre_x, centre_y = (self.centre[:, i].astype(np.float32)[sample] for i in (0, 1))
        dx, dy = x - centre_x, y - centre_y
        radius = np.hypot(dx, dy)
        scale = _flat_scale(self.distorted_radius, radius, sample)
        visible &= (radius < TABLE_REACH) & (scale * radius < _BEYOND / 2)
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

    def _oriented(
        self, x: npt.NDArray[np.floating], y: npt.NDArray[np.floating], at: object, *, before: bool
    ) -> tuple[npt.NDArray[np.floating], npt.NDArray[np.floating]]:
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


def _tangential(
    x: npt.NDArray[np.floating], y: npt.NDArray[np.floating], p1: npt.NDArray[np.floating], p2: npt.NDArray[np.floating]
) -> tuple[npt.NDArray[np.floating], npt.NDArray[np.floating]]:
    """Brown (1966): dx = 2 p1 x y + p2 (r^2 + 2 x^2), dy = p1 (r^2 + 2 y^2) + 2 p2 x y; undistorted x, y."""
    square = np.minimum(x * x + y * y, 4)
    return 2 * p1 * x * y + p2 * (square + 2 * x * x), p1 * (square + 2 * y * y) + 2 * p2 * x * y


def _project(
    matrices: Float64, x: npt.NDArray[np.floating], y: npt.NDArray[np.floating], at: object
) -> tuple[npt.NDArray[np.floating], npt.NDArray[np.floating], Bools]:
    entries = (matrices / matrices[:, 2:, 2:]).astype(x.dtype)

    def entry(row: int, column: int) -> npt.NDArray[np.floating]:
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
    value = np.where(right < _BEYOND, left + (position - below) * (right - left), _BEYOND)
    return np.asarray(np.where(radius > 1e-6, value / np.maximum(radius, 1e-6), 1.0))


def _flat_scale(table: Float64, radius: Float32, sample: Ints) -> Float32:
    position = np.minimum(radius * np.float32((TABLE_SIZE - 1) / TABLE_REACH), np.float32(TABLE_SIZE - 1.001))
    below = position.astype(np.int64)
    flat = table.astype(np.float32).ravel()
    index = sample * TABLE_SIZE + below
    left, right = flat[index], flat[index + 1]
    value = np.where(right < _BEYOND, left + (position - below.astype(np.float32)) * (right - left), _BEYOND)
    return np.asarray(np.where(radius > 1e-6, value / np.maximum(radius, np.float32(1e-6)), np.float32(1)), np.float32)


def draw_distortions(size: int, rng: np.random.Generator, kinds: Ints | None = None) -> DistortionBatch:
    """Random distortions; `kinds` (B,) fixes their kinds, otherwise they follow SHARES."""
    kind = rng.choice(len(KINDS), size, p=np.array(SHARES) / sum(SHARES)) if kinds is None else kinds
    mirror_x, mirror_y = rng.random(size) < 0.5, rng.random(size) < 0.5
    mild = _is(kind, "mixture")
    waving = _is(kind, "wave") | (mild & (rng.random(size) < 0.2))
    magnitude = np.where(waving, rng.uniform(0, 0.25, size) * np.where(mild, 0.6, 1.0), 0.0)
    lzsl_phase = math.pi * (-LZSL_CENTRE)
    phase = np.where(mild & (rng.random(size) < 0.5), rng.uniform(0, 2 * math.pi, size), lzsl_phase)
    undistorted, distorted = radius_tables(size, kind, waving, rng)
    can_turn = np.isin(kind, [KINDS.index(k) for k in ("wave", "shear", "projective", "mixture")])
    return DistortionBatch(
        kind=kind,
        undistorted_radius=undistorted,
        distorted_radius=distorted,
        centre=_centres(kind, rng),
        tangential=_tangentials(kind, rng),
        wave=np.stack([magnitude, phase], 1),
        homography=_homographies(kind, rng),
        mirror_x=mirror_x,
        mirror_y=mirror_y,
        transposed=can_turn & (rng.random(size) < 0.15),
    )


def _is(kind: Ints, name: str) -> Bools:
    return np.asarray(kind == KINDS.index(name))


def _centres(kind: Ints, rng: np.random.Generator) -> Float64:
    size = len(kind)
    wandering = np.isin(kind, [KINDS.index(k) for k in ("division", "polynomial", "brown", "fisheye")])
    wandering &= rng.random(size) < 0.6
    wide = rng.random(size) < 0.25
    offset = rng.normal(size=(size, 2)) * np.where(wide, 0.12, 0.04)[:, None]
    return np.where(wandering[:, None], offset.clip(-0.3, 0.3), LZSL_CENTRE)


def _tangentials(kind: Ints, rng: np.random.Generator) -> Float64:
    tilted = _is(kind, "brown") & (rng.random(len(kind)) < 0.5)
    return np.where(tilted[:, None], rng.normal(size=(len(kind), 2)).clip(-2.5, 2.5) * 0.006, 0.0)


def radius_tables(size: int, kind: Ints, waving: Bools, rng: np.random.Generator) -> tuple[Float64, Float64]:
    """Tables of r_u over r_d and of r_d over r_u, each (B, TABLE_SIZE), of a random lens of each kind."""
    grid = np.linspace(0, TABLE_REACH, TABLE_SIZE)
    u = rng.random(size)
    division = np.zeros((size, 2))
    inverse_polynomial = np.zeros((size, 2))
    brown = np.zeros((size, 2))
    division[:, 0] = np.select(
        [_is(kind, "barrel"), _is(kind, "pincushion"), _is(kind, "division"), _is(kind, "mixture") & ~waving],
        [-0.2048 * u, 0.35226 * u, rng.uniform(-0.3, 0.42, size), rng.uniform(-0.2048, 0.24, size)],
        0.0,
    )
    second = _is(kind, "division") & (rng.random(size) < 0.5)
    division[:, 1] = np.where(second, rng.uniform(-0.04, 0.05, size), 0.0)
    polynomial = _is(kind, "polynomial")
    inverse_polynomial[:, 0] = np.where(polynomial, rng.uniform(-0.16, 0.28, size), 0.0)
    inverse_polynomial[:, 1] = np.where(polynomial, rng.uniform(-0.06, 0.08, size), 0.0)
    conrady = _is(kind, "brown")
    brown[:, 0] = np.where(conrady, rng.normal(size=size).clip(-2, 2) * 0.12 - 0.05, 0.0)
    brown[:, 1] = np.where(conrady, rng.normal(size=size) * 0.03 - 0.15 * brown[:, 0], 0.0)
    undistorted = np.empty((size, TABLE_SIZE))
    distorted = np.empty((size, TABLE_SIZE))
    backward = np.isin(kind, [KINDS.index(k) for k in ("brown", "fisheye")])
    square = grid * grid
    forward_factor = (1 + inverse_polynomial[:, :1] * square + inverse_polynomial[:, 1:] * square**2) / np.maximum(
        1 + division[:, :1] * square + division[:, 1:] * square**2, 0.05
    )
    fisheye = _is(kind, "fisheye")
    backward_factor = np.where(
        fisheye[:, None], _fisheye_factor(grid, size, rng), 1 + brown[:, :1] * square + brown[:, 1:] * square**2
    )
    for b in range(size):
        factor = backward_factor[b] if backward[b] else forward_factor[b]
        image = _monotone(grid * factor)
        while not fisheye[b] and (image[-1] if backward[b] else grid[len(image) - 1]) < LENS_COVERS:
            factor = 1 + 0.8 * (factor - 1)  # this lens would fold inside the picture: a milder one
            image = _monotone(grid * factor)
        inverse = np.interp(grid, image, grid[: len(image)], right=_BEYOND)
        image = np.append(image, np.full(TABLE_SIZE - len(image), _BEYOND))
        undistorted[b], distorted[b] = (inverse, image) if backward[b] else (image, inverse)
    return undistorted, distorted


def _fisheye_factor(grid: Float64, size: int, rng: np.random.Generator) -> Float64:
    """r_d / r_u of equidistant lenses whose long side spans 40 to 120 degrees, with a little KB4 on top."""
    half_angle = np.radians(rng.uniform(20, 60, size))[:, None]
    focal = 1 / half_angle
    kb = rng.normal(size=(size, 2)) * np.where(rng.random(size) < 0.6, 1.0, 0.0)[:, None]
    theta = np.arctan(grid / focal)
    bent = focal * theta * (1 + 0.05 * kb[:, :1] * theta**2 + 0.015 * kb[:, 1:] * theta**4)
    return np.where(grid > 0, bent / np.maximum(grid, 1e-9), 1.0)


def _monotone(image: Float64) -> Float64:
    """The leading part of a radius table that keeps growing at no less than an eighth of its initial slope."""
    step = TABLE_REACH / (TABLE_SIZE - 1)
    flat = np.flatnonzero(np.diff(image) < step / 8)
    return image[: flat[0] + 1] if len(flat) else image


def _homographies(kind: Ints, rng: np.random.Generator) -> Float64:
    size = len(kind)
    mild = _is(kind, "mixture")
    degrees = np.where(_is(kind, "rotation"), rng.uniform(-15, 15, size), 0.0)
    degrees = np.where(mild & (rng.random(size) < 0.7), (rng.normal(size=size) * 5).clip(-12, 12), degrees)
    inset = np.where(_is(kind, "projective"), rng.uniform(0.1, 0.2, size), 0.0)
    inset = np.where(mild & (rng.random(size) < 0.5), rng.uniform(0, 0.15, size), inset)
    shear = np.where(_is(kind, "shear"), rng.uniform(-0.4, 0.4, size), 0.0)
    shear = np.where(mild & (rng.random(size) < 0.2), rng.uniform(-0.2, 0.2, size), shear)
    matrices = (
        _shears(shear) @ np.where((inset > 0)[:, None, None], _trapezoids(inset), np.eye(3)) @ _rotations(degrees)
    )
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) + rng.uniform(-0.09, 0.09, (size, 4, 2))
    free = without_scale_and_shift(_unit_square_to(corners))
    return np.where(_is(kind, "homography")[:, None, None], free, matrices)


def _about(matrices: Float64, centre: float) -> Float64:
    there = np.array([[1, 0, -centre], [0, 1, -centre], [0, 0, 1.0]])
    return np.asarray(np.linalg.inv(there) @ matrices @ there)


def _rotations(degrees: Float64) -> Float64:
    angle = np.radians(degrees)
    matrices = np.tile(np.eye(3), (len(angle), 1, 1))
    matrices[:, 0, 0] = matrices[:, 1, 1] = np.cos(angle)
    matrices[:, 0, 1] = np.sin(angle)
    matrices[:, 1, 0] = -np.sin(angle)
    return _about(matrices, LZSL_CENTRE)


def _shears(shear: Float64) -> Float64:
    matrices = np.tile(np.eye(3), (len(shear), 1, 1))
    matrices[:, 0, 1] = shear
    return _about(matrices, LZSL_CENTRE)


def _trapezoids(inset: Float64) -> Float64:
    """LZSL19 "projective": the crop's square onto a trapezoid whose bottom corners are moved in by `inset`."""
    zero, one = np.zeros_like(inset), np.ones_like(inset)
    corners = np.stack([zero, zero + 0.005, one, zero + 0.005, 1 - inset, zero + 0.995, inset, zero + 0.995], 1)
    return _unit_square_to(corners.reshape(-1, 4, 2))


def _unit_square_to(corners: Float64) -> Float64:
    """Homographies (B, 3, 3), isotropic, that take the unit square (0,0), (1,0), (1,1), (0,1) to `corners` (B, 4, 2);
    the unit square's sides are the first and last pixel centres of a 256 crop, as in LZSL19."""
    size = len(corners)
    system = np.zeros((size, 8, 8))
    right = np.zeros((size, 8))
    for i, (p, q) in enumerate(((0, 0), (1, 0), (1, 1), (0, 1))):
        x, y = corners[:, i, 0], corners[:, i, 1]
        system[:, 2 * i, :3] = system[:, 2 * i + 1, 3:6] = (p, q, 1)
        system[:, 2 * i, 6], system[:, 2 * i, 7], right[:, 2 * i] = -x * p, -x * q, x
        system[:, 2 * i + 1, 6], system[:, 2 * i + 1, 7], right[:, 2 * i + 1] = -y * p, -y * q, y
    solved = np.linalg.solve(system, right[..., None])[..., 0]
    matrices = np.concatenate([solved, np.ones((size, 1))], 1).reshape(size, 3, 3)
    edge = LZSL_CROP_CORNER / 256
    to_isotropic = np.array([[2 * edge, 0, -edge], [0, 2 * edge, -edge], [0, 0, 1.0]])
    return np.asarray(to_isotropic @ matrices @ np.linalg.inv(to_isotropic))


def without_scale_and_shift(matrices: Float64) -> Float64:
    """The same homographies followed by the shift and scale that keep the origin and the area around it: neither can
    be seen in a picture, so no network is asked for them."""
    matrices = matrices / matrices[:, 2:, 2:]
    shift = matrices[:, :2, 2]
    jacobian = matrices[:, :2, :2] - shift[:, :, None] * matrices[:, 2:, :2]
    scale = np.sqrt(np.abs(np.linalg.det(jacobian)))
    back = np.tile(np.eye(3), (len(matrices), 1, 1))
    back[:, 0, 0] = back[:, 1, 1] = 1 / scale
    back[:, :2, 2] = -shift / scale[:, None]
    return np.asarray(back @ matrices)


def natural_tilts(size: int, share: float, rng: np.random.Generator) -> Float64:
    """Homographies (B, 3, 3) of a camera held a little askew, for `share` of the samples; these are never labelled."""
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) + rng.normal(size=(size, 4, 2)).clip(-2, 2) * 0.04
    tilt = without_scale_and_shift(_unit_square_to(corners)) @ _rotations((rng.normal(size=size) * 4).clip(-10, 10))
    return np.where((rng.random(size) < share)[:, None, None], tilt, np.eye(3))
