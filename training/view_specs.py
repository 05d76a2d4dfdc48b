"""What it takes to see a training sample: where each point of its view lies in which photograph. Isotropic frame.

Computed beside the chains of the sample, on the processor; the picture itself is drawn from these by `atlas`, wherever
the networks are trained.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from training.distortions import DistortionBatch
from training.windows import Windows

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]

LATTICE_SIDE = 35
LATTICE_REACH = 1.0625
"""The lattice spans the view's square and one step more on each side: 6 px of a view of 192."""


@dataclass(frozen=True)
class ViewSpecs:
    """Of a batch.

    target: float32 (B, LATTICE_SIDE, LATTICE_SIDE, 2), target coordinates of a lattice over the view (source frame,
    +-LATTICE_REACH, rows first). to_window: float32 (B, 3, 3), homographies that undo natural tilts. picture: int64
    (B,), index into the pictures. scale, shift: float32 (B, 2), x then y: target coordinates less shift, over scale,
    are isotropic coordinates of the picture. finer: float32 (B,), pixels of the picture per pixel that is searched.
    pixel: float32 (B,), isotropic size of a searched pixel.
    """

    target: Float32
    to_window: Float32
    picture: npt.NDArray[np.int64]
    scale: Float32
    shift: Float32
    finer: Float32
    pixel: Float32


def view_specs(distortions: DistortionBatch, half_extent: Float64, windows: Windows, tilts: Float64) -> ViewSpecs:
    """The views of distorted, tilted windows; half_extent (B, 2), tilts (B, 3, 3)."""
    steps = np.linspace(-LATTICE_REACH, LATTICE_REACH, LATTICE_SIDE)
    grid_x, grid_y = (np.broadcast_to(a.ravel(), (distortions.size, a.size)) for a in np.meshgrid(steps, steps))
    # Beyond a picture's own border nothing is shown, and a lens may fold there.
    reach = half_extent + 2 * (steps[1] - steps[0])
    x, y = distortions.straighten(
        grid_x.clip(-reach[:, :1], reach[:, :1]).copy(), grid_y.clip(-reach[:, 1:], reach[:, 1:]).copy()
    )
    target = np.stack([x, y], -1).reshape(-1, LATTICE_SIDE, LATTICE_SIDE, 2)
    return ViewSpecs(
        target=target.clip(-4, 4).astype(np.float32),
        to_window=np.linalg.inv(tilts).astype(np.float32),
        picture=windows.picture,
        scale=np.stack([windows.scale_x, windows.scale_y], 1),
        shift=np.stack(windows.shift, 1),
        finer=(1 / windows.level).astype(np.float32),
        pixel=windows.pixel,
    )
