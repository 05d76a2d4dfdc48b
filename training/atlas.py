"""The training pictures on the device that trains, and the views of them that distorted cameras would have.

One view takes 20 ms on a processor core (`picture_sampler`, which also searches it for chains) and a few microseconds
on a GPU, where millions of them can be seen.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn.functional import conv2d, grid_sample, pad

from training.view_specs import LATTICE_REACH
from unbend_service.adapters.estimators.views import VIEW_PX

_REDUCTIONS = 4
"""Each picture is kept at so many scales, each half the one before."""
_COARSER = 0.2
"""Added to the binary logarithm of the reduction, against aliasing: one sample is taken per pixel of a view."""


class Atlas:
    """Grey uint8 pictures of any size on `device`, each reduced _REDUCTIONS - 1 times."""

    def __init__(self, pictures: list[npt.NDArray[np.uint8]], device: torch.device) -> None:
        scales = [_reduced(picture) for picture in pictures]
        sizes = np.array([[s.shape for s in scaled] for scaled in scales], np.int64)
        lengths = sizes.prod(-1).ravel()
        offsets = (np.cumsum(lengths) - lengths).reshape(len(pictures), _REDUCTIONS)
        self._flat = torch.from_numpy(np.concatenate([s.ravel() for scaled in scales for s in scaled])).to(device)
        self._sizes, self._offsets = torch.from_numpy(sizes).to(device), torch.from_numpy(offsets).to(device)
        centres = (2 * torch.arange(VIEW_PX, device=device) + 1) / VIEW_PX - 1
        self._at = torch.stack(torch.meshgrid(centres, centres, indexing="xy"), -1)

    def views(self, specs: dict[str, Tensor], extent: Tensor, generator: torch.Generator) -> Tensor:
        """The views (B, 1, VIEW_PX, VIEW_PX), float32 in 0..1, as `views.view_of` makes them of what cameras with
        other tone, softness and noise show.

        specs: the fields of `ViewSpecs`. extent: (B, 2), half extents of the pictures.
        """
        size = len(extent)
        lattice = specs["target"].permute(0, 3, 1, 2)
        at = (self._at / LATTICE_REACH).expand(size, -1, -1, -1)
        # In the target frame; then without the natural tilt; then in the frame of the picture: all isotropic.
        x, y = grid_sample(lattice, at, mode="bicubic", padding_mode="border", align_corners=True).unbind(1)
        entry = specs["to_window"][:, :, :, None, None]
        depth = (entry[:, 2, 0] * x + entry[:, 2, 1] * y + entry[:, 2, 2]).clamp(min=0.2)
        moved_x = (entry[:, 0, 0] * x + entry[:, 0, 1] * y + entry[:, 0, 2]) / depth
        moved_y = (entry[:, 1, 0] * x + entry[:, 1, 1] * y + entry[:, 1, 2]) / depth
        scale, shift = specs["scale"][:, :, None, None], specs["shift"][:, :, None, None]
        x, y = (moved_x - shift[:, 0]) / scale[:, 0], (moved_y - shift[:, 1]) / scale[:, 1]
        searched_px = 2 / specs["pixel"]
        footprint = specs["finer"] * searched_px / VIEW_PX
        reduction = (torch.log2(footprint) + _COARSER).round().long().clamp(0, _REDUCTIONS - 1)
        view = self._sampled(x, y, specs["picture"], reduction)[:, None]
        view = _developed(view, searched_px / VIEW_PX, generator)
        return _framed(view, extent)

    def _sampled(self, x: Tensor, y: Tensor, picture: Tensor, reduction: Tensor) -> Tensor:
        """Pictures (B,) at isotropic coordinates (B, h, w), bilinear, mirrored beyond their borders; in 0..1."""
        rows, columns = self._sizes[picture, reduction].unbind(-1)
        half_long = torch.maximum(rows, columns)[:, None, None] / 2
        x = x * half_long + (columns / 2 - 0.5)[:, None, None]
        y = y * half_long + (rows / 2 - 0.5)[:, None, None]
        left, top = torch.floor(x), torch.floor(y)
        across, down = x - left, y - top
        rows, columns = rows[:, None, None], columns[:, None, None]
        first = self._offsets[picture, reduction][:, None, None]
        corner = []
        for dy in (0, 1):
            line = first + _mirrored(top.long() + dy, rows) * columns
            corner += [self._flat[line + _mirrored(left.long() + dx, columns)].float() for dx in (0, 1)]
        above = corner[0] + (corner[1] - corner[0]) * across
        below = corner[2] + (corner[3] - corner[2]) * across
        return (above + (below - above) * down) / 255


def _reduced(picture: npt.NDArray[np.uint8]) -> list[npt.NDArray[np.uint8]]:
    scales = [picture]
    for _ in range(_REDUCTIONS - 1):
        rows, columns = scales[-1].shape
        size = (max(4, round(columns / 2)), max(4, round(rows / 2)))
        scales.append(np.asarray(cv2.resize(scales[-1], size, interpolation=cv2.INTER_AREA), np.uint8))
    return scales


def _mirrored(index: Tensor, count: Tensor) -> Tensor:
    folded = index.remainder(2 * count)
    return torch.minimum(folded, 2 * count - 1 - folded)


def _developed(view: Tensor, reduced: Tensor, generator: torch.Generator) -> Tensor:
    """Tone, softness and noise of another camera, as in `picture_sampler`; reduced: (B,), searched pixels per pixel
    of the view, over which noise and softness average."""
    size, device = len(view), view.device

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(size, 1, 1, 1, device=device, generator=generator)

    view = (view.clamp(0, 1) ** uniform(0.7, 1.4) * uniform(0.75, 1.0) + uniform(0.0, 0.1)).clamp(0, 1)
    kernel = torch.tensor([[1.0, 2.0, 1.0], [2.0, 4.0, 2.0], [1.0, 2.0, 1.0]], device=device) / 16
    soft = conv2d(pad(view, (1, 1, 1, 1), mode="replicate"), kernel[None, None])
    # A kernel of variance 1/2: blended in, it has that of the blur that is meant.
    variance = (uniform(0.4, 1.0) / reduced[:, None, None, None]) ** 2
    view = torch.lerp(view, soft, torch.where(uniform(0, 1) < 0.2, (2 * variance).clamp(max=1), 0.0))
    noise = torch.randn(view.shape, device=device, generator=generator) * uniform(0, 6) / 255
    return (view + torch.where(uniform(0, 1) < 0.4, noise / reduced[:, None, None, None], 0.0)).clamp(0, 1)


def _framed(view: Tensor, extent: Tensor) -> Tensor:
    """Beside the picture its mean."""
    centres = (2 * torch.arange(VIEW_PX, device=view.device) + 1) / VIEW_PX - 1
    # The picture takes a whole number of pixels, as many on either side.
    half = torch.round(extent * VIEW_PX) / VIEW_PX
    inside = (centres.abs() < half[:, 1:])[:, :, None] & (centres.abs() < half[:, :1])[:, None, :]
    shown = inside[:, None].float()
    mean = (view * shown).sum((1, 2, 3), keepdim=True) / shown.sum((1, 2, 3), keepdim=True)
    return view * shown + mean * (1 - shown)
