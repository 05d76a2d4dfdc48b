"""The second look: the same pictures again, their chains straightened by the network's own estimate.

The service looks twice at strong lenses (`LinesetEstimator`), so the network learns from what its first look leaves.
What is left is a distortion like any other: a chain point lies where the first estimate straightened it to, and the
true map to it is the true map followed by that straightening.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from training.labels import fit_labels
from training.sampler import TrainingBatch
from training.straightening import Straightening
from unbend_service.adapters.estimators.chain_features import describe

Float32 = npt.NDArray[np.float32]

EXTENT = 1.3
"""Half extents of the picture beyond which straightened points are not looked at, as in the service."""


def second_look(batch: TrainingBatch, values: Tensor, straightening: Straightening) -> TrainingBatch:
    """The batch as the second look meets it, after a first look that gave `values` (B, 72)."""
    points, half_extent = batch.points, batch.points.half_extent
    curves = straightening.curves(values.detach().float())
    x, y = _straightened(straightening, curves, points.x, points.y, points.picture)
    near = (np.abs(x) < EXTENT * half_extent[:, 0][points.picture]) & (
        np.abs(y) < EXTENT * half_extent[:, 1][points.picture]
    )
    seen = points.moved(x, y).kept(near)
    size, count = batch.weight.shape
    picture = np.repeat(np.arange(size), count)
    flat_x, flat_y = _straightened(
        straightening, curves, batch.source[..., 0].ravel(), batch.source[..., 1].ravel(), picture
    )
    source = np.stack([flat_x, flat_y], -1).reshape(size, count, 2)
    inside = (np.abs(source) < EXTENT * half_extent[:, None]).all(-1)
    weight = batch.weight * np.where(inside, 1.0, 0.05).astype(np.float32)
    known = len(batch.labels)
    x_source, y_source = source[:known].astype(np.float64).transpose(2, 0, 1)
    x_target, y_target = batch.target[:known].astype(np.float64).transpose(2, 0, 1)
    labels = fit_labels(x_source, y_source, x_target, y_target, weight[:known].astype(np.float64))
    return replace(
        batch,
        chains=describe(seen),
        points=seen,
        source=source,
        weight=weight,
        # What is left of a lens hardly stretches.
        slopes=np.broadcast_to(np.eye(2, dtype=np.float32), batch.slopes.shape).copy(),
        labels=labels.astype(np.float32),
    )


def _straightened(
    straightening: Straightening, curves: Tensor, x: Float32, y: Float32, picture: npt.NDArray[np.int64]
) -> tuple[Float32, Float32]:
    """Target coordinates of flat source points under the curves (B, 72) of their pictures."""
    with torch.no_grad():
        own = curves.index_select(0, torch.from_numpy(picture))
        s, t = straightening.straightened(own, torch.from_numpy(x)[:, None], torch.from_numpy(y)[:, None])
    return s[:, 0].numpy(), t[:, 0].numpy()
