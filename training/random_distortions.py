"""Random distortions: which kinds there are, how often each is drawn, and how far each goes."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from training.distortions import BEYOND, TABLE_REACH, TABLE_SIZE, DistortionBatch
from training.homographies import LZSL_CENTRE, rotations, shears, trapezoids, unit_square_to, without_scale_and_shift

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
SHARES = (0.07, 0.085, 0.09, 0.06, 0.06, 0.09, 0.10, 0.09, 0.05, 0.08, 0.075, 0.03, 0.12)

LENS_COVERS = 1.5
"""Distorted radius that a lens must reach without a fold; a square picture's corner is at 1.41. (An equidistant
fisheye never folds, it only runs out of the table.)"""


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
        image = monotone(grid * factor)
        while not fisheye[b] and (image[-1] if backward[b] else grid[len(image) - 1]) < LENS_COVERS:
            factor = 1 + 0.8 * (factor - 1)  # this lens would fold inside the picture: a milder one
            image = monotone(grid * factor)
        inverse = np.interp(grid, image, grid[: len(image)], right=BEYOND)
        image = np.append(image, np.full(TABLE_SIZE - len(image), BEYOND))
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


def monotone(image: Float64) -> Float64:
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
    matrices = shears(shear) @ np.where((inset > 0)[:, None, None], trapezoids(inset), np.eye(3)) @ rotations(degrees)
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) + rng.uniform(-0.09, 0.09, (size, 4, 2))
    free = without_scale_and_shift(unit_square_to(corners))
    return np.where(_is(kind, "homography")[:, None, None], free, matrices)


def fixed_distortion(
    division: float = 0.0,
    degrees: float = 0.0,
    shear: float = 0.0,
    inset: float = 0.0,
    wave: tuple[float, float] = (0.0, 0.0),
) -> DistortionBatch:
    """A batch of one, LZSL19's own order: division lens or wave, rotation, trapezoid, shear.

    Args:
        division: l1 of the division model, isotropic. degrees: of rotation. inset: of the trapezoid's bottom corners.
        wave: magnitude and phase, isotropic and radians.
    """
    grid = np.linspace(0, TABLE_REACH, TABLE_SIZE)
    image = monotone(grid / np.maximum(1 + division * grid * grid, 0.05))
    inverse = np.interp(grid, image, grid[: len(image)], right=BEYOND)
    image = np.append(image, np.full(TABLE_SIZE - len(image), BEYOND))
    pose = rotations(np.array([degrees]))
    if inset:
        pose = trapezoids(np.array([inset])) @ pose
    no = np.array([False])
    return DistortionBatch(
        kind=np.zeros(1, np.int64),
        undistorted_radius=image[None],
        distorted_radius=inverse[None],
        centre=np.full((1, 2), LZSL_CENTRE),
        tangential=np.zeros((1, 2)),
        wave=np.array([wave]),
        homography=shears(np.array([shear])) @ pose,
        mirror_x=no,
        mirror_y=no,
        transposed=no,
    )
