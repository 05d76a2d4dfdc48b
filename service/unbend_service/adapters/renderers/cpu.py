"""CpuRenderer: cv2.remap with float maps that are kept for each grid and size."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain, islice

import cv2
import numpy as np

from unbend_service.adapters.renderers.recent import Recent
from unbend_service.adapters.renderers.sampling import Float32, PlaneSampling
from unbend_service.application.ports import Bytes, RendererInfo
from unbend_service.domain.errors import InvalidFrame, RenderFailed
from unbend_service.domain.frames import Border, Frame, planes, split_planes
from unbend_service.domain.grid import Grid

#: cv2.remap keeps positions in 16 bits.
_LONGEST_PX = 32_766
#: A packed 3-channel plane up to this size goes through RGBA, which cv2.remap samples three times as fast.
_WIDENED_BYTES = 64 << 20
#: The border is painted from a block of so many rows, which stays in the cache of the processor.
_PAINT_ROWS = 64


@dataclass(frozen=True, slots=True)
class _Strip:
    """Sampling maps of some rows: (rows, width) float32 positions, and uint8 255 where the border is painted."""

    first: int
    end: int
    map_x: Float32
    map_y: Float32
    outside: Bytes | None

    @property
    def size_bytes(self) -> int:
        return self.map_x.nbytes + self.map_y.nbytes + (0 if self.outside is None else self.outside.nbytes)


def _make_strips(grid: Grid, sampling: PlaneSampling, skipped: int = 0) -> Iterator[_Strip]:
    """The strips of a plane but the first few."""
    inside = sampling.shows_only_source(grid)
    low, (high_x, high_y) = sampling.valid_low, sampling.valid_high
    for first, end in islice(sampling.strips(), skipped, None):
        map_x, map_y = sampling.source_maps(grid, first, end)
        outside = None
        if not inside:
            valid = cv2.bitwise_and(
                cv2.inRange(map_x, np.array(low), np.array(high_x)), cv2.inRange(map_y, np.array(low), np.array(high_y))
            )
            outside = cv2.bitwise_not(valid)
            if not outside.any():
                outside = None
        yield _Strip(first, end, map_x, map_y, outside)  # type: ignore[arg-type]  # cv2's stubs type every Mat alike


class CpuRenderer:
    """Renders with cv2.remap.

    Maps are float32, not fixed-point: exact to half a grey level, and with OpenCV 5 also the faster for one and four
    channels. Cost of a frame with warm maps: one remap per plane and a masked copy where the border shows; the first
    frame of a grid and size also makes the maps, about twice that.

    Args:
        cache_bytes: bound on the maps that are kept.
    """

    def __init__(self, cache_bytes: int = 256 << 20) -> None:
        self._cache_bytes = cache_bytes
        self._maps: Recent[tuple[str, PlaneSampling], tuple[_Strip, ...]] = Recent(cache_bytes)
        self._wide: tuple[Bytes, Bytes] | None = None
        self._split: tuple[Bytes, ...] | None = None

    @property
    def info(self) -> RendererInfo:
        return RendererInfo("cpu", f"OpenCV {cv2.__version__} remap", hardware=False)

    @property
    def kept_bytes(self) -> int:
        """Bytes of the maps that are kept now."""
        return self._maps.size_bytes

    def render(self, source: Frame, grid: Grid, border: Border, target: Bytes) -> None:
        """See :class:`~unbend_service.application.ports.Renderer`.

        Raises:
            InvalidFrame: a side is longer than OpenCV can address.
            RenderFailed: OpenCV refused.
        """
        if max(source.width, source.height) > _LONGEST_PX:
            raise InvalidFrame(
                f"A frame of {source.width}x{source.height} pixels is too large for the cpu renderer.",
                allowed=f"1 to {_LONGEST_PX} pixels on a side",
            )
        layout = planes(source.pixel_format, source.width, source.height)
        colours = border.samples(source.pixel_format)
        targets = split_planes(target, source.pixel_format, source.width, source.height)
        try:
            for plane, colour, samples, drawn in zip(layout, colours, source.plane_arrays(), targets, strict=True):
                strips = self._strips(grid, PlaneSampling.of(source, plane))
                if plane.channels == 3 and plane.size_bytes <= _WIDENED_BYTES:
                    self._draw_widened(samples, strips, colour, drawn)
                elif plane.channels == 2:
                    self._draw_split(samples, strips, colour, drawn)
                else:
                    _draw(samples, strips, colour, drawn)
        except cv2.error as error:
            raise RenderFailed(f"OpenCV could not render the frame: {error}") from error

    def _strips(self, grid: Grid, sampling: PlaneSampling) -> Iterable[_Strip]:
        """The maps of a plane. Of one so large that it would crowd out the others the first strips alone are kept."""
        key = grid.id, sampling
        kept = self._maps.get(key)
        if kept is None:
            kept, kept_bytes = (), 0
            for strip in _make_strips(grid, sampling):
                kept_bytes += strip.size_bytes
                if kept_bytes > self._cache_bytes // 2:
                    break
                kept += (strip,)
            if kept:
                self._maps.put(key, kept, sum(strip.size_bytes for strip in kept))
        whole = kept and kept[-1].end == sampling.height
        return kept if whole else chain(kept, _make_strips(grid, sampling, len(kept)))

    def _draw_widened(self, samples: Bytes, strips: Iterable[_Strip], colour: tuple[int, ...], drawn: Bytes) -> None:
        shape = (*samples.shape[:2], 4)
        if self._wide is None or self._wide[0].shape != shape:
            self._wide = np.empty(shape, np.uint8), np.empty(shape, np.uint8)
        wide, wide_drawn = self._wide
        cv2.cvtColor(samples, cv2.COLOR_RGB2RGBA, dst=wide)
        _draw(wide, strips, (*colour, 255), wide_drawn)
        cv2.cvtColor(wide_drawn, cv2.COLOR_RGBA2RGB, dst=drawn)

    def _draw_split(self, samples: Bytes, strips: Iterable[_Strip], colour: tuple[int, ...], drawn: Bytes) -> None:
        """Channel by channel: cv2.remap takes longer for two that are packed, and places them on a coarser raster."""
        shape = samples.shape[:2]
        if self._split is None or self._split[0].shape != shape:
            self._split = tuple(np.empty(shape, np.uint8) for _ in range(4))
        sources, targets = self._split[:2], self._split[2:]
        cv2.split(samples, sources)
        for strip in strips:
            for source, target, level in zip(sources, targets, colour, strict=True):
                _draw(source, (strip,), (level,), target)
        cv2.merge(targets, dst=drawn)

    def rest(self) -> None:
        """See :class:`~unbend_service.application.ports.Renderer`; the maps stay."""
        self._wide = self._split = None

    def close(self) -> None:
        self._maps.clear()
        self.rest()


def _draw(samples: Bytes, strips: Iterable[_Strip], colour: tuple[int, ...], drawn: Bytes) -> None:
    """Samples one plane into ``drawn``, both (height, width[, channels]) uint8."""
    for strip in strips:
        part = drawn[strip.first : strip.end]
        cv2.remap(samples, strip.map_x, strip.map_y, cv2.INTER_LINEAR, dst=part, borderMode=cv2.BORDER_REPLICATE)
        if strip.outside is not None:
            paint = np.empty_like(part[:_PAINT_ROWS])
            paint[:] = colour[0] if len(colour) == 1 else np.array(colour, np.uint8)
            for row in range(0, len(part), _PAINT_ROWS):
                band = part[row : row + _PAINT_ROWS]
                cv2.copyTo(paint[: len(band)], strip.outside[row : row + _PAINT_ROWS], dst=band)
