from __future__ import annotations

import numpy as np
import pytest

from unbend_service.adapters.renderers import sampling
from unbend_service.adapters.renderers.cpu import CpuRenderer
from unbend_service.domain.frames import Border, Bytes, Frame, PixelFormat, frame_size_bytes
from unbend_service.domain.grid import Grid

GRID = Grid.from_map(lambda p: p * (0.95 + 0.1 * (p**2).sum(axis=-1, keepdims=True)))
FORMATS = [PixelFormat.RGB24, PixelFormat.NV12]


def frame(pixel_format: PixelFormat) -> Frame:
    size_bytes = frame_size_bytes(pixel_format, 203, 151)
    return Frame(pixel_format, 203, 151, np.random.default_rng(3).integers(0, 256, size_bytes, np.uint8))


def rendered(renderer: CpuRenderer, source: Frame) -> Bytes:
    target = np.empty_like(source.data)
    renderer.render(source, GRID, Border(9, 99, 199), target)
    return target


@pytest.mark.parametrize("pixel_format", FORMATS)
def test_a_frame_rendered_in_strips_has_no_seams(monkeypatch: pytest.MonkeyPatch, pixel_format: PixelFormat) -> None:
    """Very large frames are rendered part by part, and nobody can tell."""
    whole = rendered(CpuRenderer(), frame(pixel_format))
    monkeypatch.setattr(sampling, "STRIP_SAMPLES", 203 * 7)
    np.testing.assert_array_equal(rendered(CpuRenderer(), frame(pixel_format)), whole)


@pytest.mark.parametrize("pixel_format", FORMATS)
def test_maps_that_would_fill_the_cache_are_not_kept(pixel_format: PixelFormat) -> None:
    """One huge frame does not drive out the maps of the others, and is rendered all the same."""
    small = CpuRenderer(cache_bytes=1 << 10)
    np.testing.assert_array_equal(rendered(small, frame(pixel_format)), rendered(CpuRenderer(), frame(pixel_format)))
    assert small.kept_bytes == 0


def test_of_maps_that_would_fill_the_cache_a_part_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """What of a huge frame's maps fits into half of the cache need not be made again, and nobody can tell."""
    monkeypatch.setattr(sampling, "STRIP_SAMPLES", 203 * 7)
    source, cache_bytes = frame(PixelFormat.RGB24), 8 * 203 * 151
    whole, small = CpuRenderer(), CpuRenderer(cache_bytes)
    for _ in range(2):
        np.testing.assert_array_equal(rendered(small, source), rendered(whole, source))
        assert cache_bytes // 4 < small.kept_bytes <= cache_bytes // 2


def test_maps_are_shared_by_planes_and_formats_of_one_size() -> None:
    """A second frame of a grid and size costs no new maps, whatever its colours."""
    renderer = CpuRenderer()
    rendered(renderer, frame(PixelFormat.RGB24))
    kept = renderer.kept_bytes
    rendered(renderer, frame(PixelFormat.BGRA))
    assert renderer.kept_bytes == kept
    rendered(renderer, frame(PixelFormat.I420))
    assert kept < renderer.kept_bytes < kept * 1.3
    renderer.close()
    assert renderer.kept_bytes == 0
