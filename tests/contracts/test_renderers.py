"""What every implementation of the port Renderer keeps to."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import numpy.typing as npt
import pytest
import skimage.data

from unbend_service.adapters.renderers.cpu import CpuRenderer
from unbend_service.adapters.renderers.egl import EglRenderer
from unbend_service.application.ports import Renderer
from unbend_service.domain.errors import InvalidFrame
from unbend_service.domain.fit import CROP, FULL, KEEP, Fit, with_fit
from unbend_service.domain.frames import (
    BLACK,
    TRANSPARENT,
    Border,
    Bytes,
    Frame,
    PixelFormat,
    frame_size_bytes,
    planes,
    split_planes,
)
from unbend_service.domain.grid import Grid
from unbend_service.domain.maps import Float64

SIZES = [(1, 1), (2, 1), (1, 5), (3, 3), (8, 6), (101, 75)]
VIOLET = Border(200, 30, 250, 128)


def radial(bend: float, scale: float = 1.0) -> Grid:
    """bend > 0 draws points outwards, so the corners of the target show what is outside the source."""
    return Grid.from_map(lambda p: p * (scale + bend * (p**2).sum(axis=-1, keepdims=True)))


def wave(p: Float64) -> Float64:
    return p + 0.03 * np.sin(5 * p[..., ::-1])


def rotation(p: Float64) -> Float64:
    c, s = np.cos(0.2), np.sin(0.2)
    return p @ np.array([[c, s], [-s, c]])


GRIDS = {
    "barrel": radial(0.12),
    "pincushion": radial(-0.1, 1.1),
    "wave": Grid.from_map(wave),
    "rotation": Grid.from_map(rotation, 33, 50),
    "coarse": Grid(np.array([[[-0.9, -1.2], [1.1, -0.8]], [[-0.8, 0.9], [0.9, 1.3]]])),
    "uneven": Grid.from_map(wave, 3, 6),
}


@cache
def fitted(name: str, fit: Fit) -> Grid:
    return with_fit(GRIDS[name], fit)


def smooth_frame(pixel_format: PixelFormat, width: int, height: int) -> Frame:
    """Every plane is another smooth function, so that a reference in floating point is near whatever is rendered."""
    data = np.empty(frame_size_bytes(pixel_format, width, height), np.uint8)
    for number, plane in enumerate(split_planes(data, pixel_format, width, height)):
        y, x = np.mgrid[0 : plane.shape[0], 0 : plane.shape[1]]
        for channel in range(plane.shape[2] if plane.ndim == 3 else 1):
            phase = number + 2.0 * channel
            values = 128 + 60 * np.sin(0.21 * x + phase) + 60 * np.cos(0.17 * y - phase)
            plane[..., *([channel] if plane.ndim == 3 else [])] = np.round(values)
    return Frame(pixel_format, width, height, data)


def noise_frame(pixel_format: PixelFormat, width: int, height: int) -> Frame:
    size = frame_size_bytes(pixel_format, width, height)
    return Frame(pixel_format, width, height, np.random.default_rng(size).integers(0, 256, size, np.uint8))


@cache
def photograph(pixel_format: PixelFormat) -> Frame:
    """A photograph of 512x512, cut to an odd size."""
    rgb = np.ascontiguousarray(skimage.data.astronaut()[:389, :511])
    height, width = rgb.shape[:2]
    if pixel_format is PixelFormat.GRAY8:
        data = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    elif pixel_format in (PixelFormat.I420, PixelFormat.NV12, PixelFormat.YUVJ420P):
        y, v, u = cv2.split(cv2.cvtColor(rgb, cv2.COLOR_RGB2YCrCb))
        u, v = (cv2.resize(c, ((width + 1) // 2, (height + 1) // 2), interpolation=cv2.INTER_AREA) for c in (u, v))
        chroma = [np.stack([u, v], -1).ravel()] if pixel_format is PixelFormat.NV12 else [u.ravel(), v.ravel()]
        data = np.concatenate([y.ravel(), *chroma])
    else:
        order = {"rgb24": "RGB", "bgr24": "BGR", "rgba": "RGBA", "bgra": "BGRA"}[pixel_format]
        alpha = np.full((height, width), 180, np.uint8)
        data = np.stack([alpha if c == "A" else rgb[..., "RGB".index(c)] for c in order], axis=-1)
    return Frame(pixel_format, width, height, np.ascontiguousarray(data.ravel()))


def rendered(renderer: Renderer, frame: Frame, grid: Grid, border: Border = BLACK) -> Bytes:
    target = np.full_like(frame.data, 77)
    renderer.render(frame, grid, border, target)
    return target


def target_points(width: int, height: int, chroma: bool) -> Float64:
    """Centred target points of the samples of a plane, by the words of the design alone."""
    step = 2 if chroma else 1
    columns = np.arange(0, width, step) + (step - 1) / 2
    rows = np.arange(0, height, step) + (step - 1) / 2
    x, y = np.meshgrid(2 * (columns + 0.5) / width - 1, 2 * (rows + 0.5) / height - 1)
    return np.stack([x, y], axis=-1)


@cache
def masks(grid: Grid, width: int, height: int, chroma: bool) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Where the samples of a plane surely show the inside of the source, and where surely not."""
    source = grid(target_points(width, height, chroma))
    margin = 0.1 * 2 / np.array([width, height])
    return (np.abs(source) <= 1 - margin).all(axis=-1), (np.abs(source) > 1 + margin).any(axis=-1)


def reference(frame: Frame, grid: Grid) -> list[Float64]:
    """Each plane in float64, as if all of it showed the source."""
    drawn = []
    layout = planes(frame.pixel_format, frame.width, frame.height)
    for plane, samples in zip(layout, frame.plane_arrays(), strict=True):
        step = 2 if plane.chroma else 1
        source = grid(target_points(frame.width, frame.height, plane.chroma))
        pixel = (source + 1) / 2 * [frame.width, frame.height] - 0.5
        x, y = np.moveaxis((pixel - (step - 1) / 2) / step, -1, 0)
        values = samples.reshape(plane.height, plane.width, plane.channels).astype(np.float64)

        def at(column, row, values=values, plane=plane):
            return values[np.clip(row, 0, plane.height - 1), np.clip(column, 0, plane.width - 1)]

        c, r = np.floor(x).astype(int), np.floor(y).astype(int)
        u, v = (x - c)[..., None], (y - r)[..., None]
        top = at(c, r) * (1 - u) + at(c + 1, r) * u
        bottom = at(c, r + 1) * (1 - u) + at(c + 1, r + 1) * u
        drawn.append(top * (1 - v) + bottom * v)
    return drawn


def sample_planes(frame: Frame, data: Bytes) -> list[Bytes]:
    layout = planes(frame.pixel_format, frame.width, frame.height)
    views = split_planes(data, frame.pixel_format, frame.width, frame.height)
    return [view.reshape(p.height, p.width, p.channels) for view, p in zip(views, layout, strict=True)]


def psnr_db(first: Bytes, second: Bytes) -> float:
    return float(10 * np.log10(255**2 / max(((first.astype(float) - second) ** 2).mean(), 1e-9)))


@pytest.mark.parametrize("pixel_format", list(PixelFormat))
@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
def test_the_identity_gives_back_the_same_bytes(renderer: Renderer, pixel_format: PixelFormat, size: tuple[int, int]):
    """A frame that needs no correction is not changed by a single bit, of whatever format and size."""
    frame = noise_frame(pixel_format, *size)
    for points in (2, 9, 65, 100):
        np.testing.assert_array_equal(rendered(renderer, frame, Grid.identity(points, points + 1)), frame.data)


@pytest.mark.parametrize("pixel_format", list(PixelFormat))
@pytest.mark.parametrize("name", GRIDS)
def test_every_sample_is_what_the_port_says(renderer: Renderer, pixel_format: PixelFormat, name: str):
    """Inside it is the bilinear sample of the source, outside the colour of the border, to two grey levels."""
    frame = smooth_frame(pixel_format, 97, 64)
    grid = GRIDS[name]
    drawn = sample_planes(frame, rendered(renderer, frame, grid, VIOLET))
    layout = planes(pixel_format, frame.width, frame.height)
    for plane, samples, wanted, colour in zip(
        layout, drawn, reference(frame, grid), VIOLET.samples(pixel_format), strict=True
    ):
        inside, outside = masks(grid, frame.width, frame.height, plane.chroma)
        assert inside.mean() > 0.3
        assert np.abs(samples - wanted)[inside].max() <= 2
        assert (samples[outside] == colour).all()


@pytest.mark.egl
@pytest.mark.parametrize("pixel_format", list(PixelFormat))
@pytest.mark.parametrize("fit", [KEEP, CROP, Fit(0.5), FULL], ids=str)
def test_both_renderers_give_the_same_picture(
    cpu_renderer: CpuRenderer, egl_renderer: EglRenderer, pixel_format: PixelFormat, fit: Fit
):
    """Whoever moves from one renderer to the other sees no difference: at least 45 dB inside, the same border."""
    frame = photograph(pixel_format)
    for name, border in (("barrel", BLACK), ("pincushion", TRANSPARENT), ("wave", VIOLET)):
        grid = fitted(name, fit)
        cpu = sample_planes(frame, rendered(cpu_renderer, frame, grid, border))
        egl = sample_planes(frame, rendered(egl_renderer, frame, grid, border))
        for plane, first, second in zip(planes(pixel_format, frame.width, frame.height), cpu, egl, strict=True):
            inside, outside = masks(grid, frame.width, frame.height, plane.chroma)
            assert psnr_db(first[inside], second[inside]) >= 45
            np.testing.assert_array_equal(first[outside], second[outside])


@pytest.mark.parametrize("pixel_format", [PixelFormat.RGB24, PixelFormat.NV12])
def test_a_picture_8192_wide_is_rendered_as_exactly(renderer: Renderer, pixel_format: PixelFormat):
    """Large panoramas lose no precision at their far end."""
    frame = smooth_frame(pixel_format, 8192, 12)
    np.testing.assert_array_equal(rendered(renderer, frame, Grid.identity()), frame.data)
    shifted = Grid.from_map(lambda p: p * [0.999, 0.9])
    drawn = sample_planes(frame, rendered(renderer, frame, shifted))
    for samples, wanted in zip(drawn, reference(frame, shifted), strict=True):
        assert np.abs(samples - wanted).max() <= 2


@pytest.mark.parametrize("pixel_format", list(PixelFormat))
def test_a_cropped_picture_shows_no_border(renderer: Renderer, pixel_format: PixelFormat):
    """crop guarantees that every sample comes from the source, also on the outermost rows and columns."""
    for size in ((120, 90), (75, 51), (1, 1)):
        size_bytes = frame_size_bytes(pixel_format, *size)
        frame = Frame(pixel_format, *size, np.random.default_rng(1).integers(110, 140, size_bytes, np.uint8))
        for name in ("barrel", "pincushion", "wave", "rotation"):
            drawn = rendered(renderer, frame, fitted(name, CROP), Border(255, 255, 255, 255))
            assert drawn.min() >= 110
            assert drawn.max() < 140


@pytest.mark.parametrize("pixel_format", [PixelFormat.RGBA, PixelFormat.BGRA])
def test_a_translucent_border_keeps_its_alpha_and_the_order_of_channels(renderer: Renderer, pixel_format: PixelFormat):
    """The corner that shows nothing of the source has exactly the asked colour and alpha."""
    frame = noise_frame(pixel_format, 64, 48)
    corner = sample_planes(frame, rendered(renderer, frame, radial(0.3), VIOLET))[0][0, 0]
    assert tuple(corner) == ((200, 30, 250, 128) if pixel_format is PixelFormat.RGBA else (250, 30, 200, 128))


@pytest.mark.parametrize("pixel_format", [PixelFormat.I420, PixelFormat.NV12])
def test_a_black_border_has_neutral_chroma(renderer: Renderer, pixel_format: PixelFormat):
    """Black stays black in YUV: luma 16, both colour differences 128."""
    frame = noise_frame(pixel_format, 65, 47)
    luma, *chroma = sample_planes(frame, rendered(renderer, frame, radial(0.3)))
    assert luma[0, 0] == luma[-1, -1] == 16
    assert all((plane[corner] == 128).all() for plane in chroma for corner in ((0, 0), (-1, -1)))


@pytest.mark.parametrize("pixel_format", [PixelFormat.I420, PixelFormat.NV12])
@pytest.mark.parametrize("size", [(128, 96), (127, 95)], ids=["even", "odd"])
def test_luma_and_chroma_stay_aligned(renderer: Renderer, pixel_format: PixelFormat, size: tuple[int, int]):
    """Colour does not bleed over edges: after the correction a chroma sample still belongs to its four pixels."""
    width, height = size
    data = np.empty(frame_size_bytes(pixel_format, width, height), np.uint8)
    frame = Frame(pixel_format, width, height, data)
    for plane, layout in zip(sample_planes(frame, data), planes(pixel_format, width, height), strict=True):
        x, y = np.moveaxis(target_points(width, height, layout.chroma), -1, 0)
        # steep triangular waves, 8 levels a pixel: half a pixel amiss would show as 4 levels
        plane[:] = np.round(128 + 60 * np.arcsin(np.sin(8 * x + 5 * y)))[..., None]
    luma, *chroma = sample_planes(frame, rendered(renderer, frame, radial(0.1, 0.85)))
    means = luma[: height // 2 * 2, : width // 2 * 2, 0].reshape(height // 2, 2, width // 2, 2).mean(axis=(1, 3))
    for plane in chroma:
        for channel in range(plane.shape[2]):
            difference = plane[: height // 2, : width // 2, channel] - means
            assert abs(np.median(difference)) < 0.5
            assert np.median(np.abs(difference)) < 1


def test_a_renderer_serves_sizes_and_grids_in_any_order(renderer: CpuRenderer | EglRenderer):
    """What was rendered before never shows in a frame, and what is kept stays within its bound."""
    grids = [radial(0.01 * n, 0.9) for n in range(12)]
    frames = [noise_frame(list(PixelFormat)[n % 7], 300 + 40 * n, 301 - 7 * n) for n in range(12)]
    first = [rendered(renderer, frame, grid) for frame, grid in zip(frames, grids, strict=True)]
    kept = []
    for turn in (frames, frames[::-1]):
        for frame in turn:
            rendered(renderer, frame, grids[5], VIOLET)
            kept.append(renderer.kept_bytes)
    again = [rendered(renderer, frame, grid) for frame, grid in zip(frames, grids, strict=True)]
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, other)
    assert max(kept) <= 2 * (32 << 20)


def test_the_source_may_be_read_only_and_is_left_alone(renderer: Renderer):
    """A renderer may be given a view of somebody else's buffer."""
    frame = noise_frame(PixelFormat.BGR24, 33, 21)
    before = frame.data.copy()
    frame.data.flags.writeable = False
    rendered(renderer, frame, GRIDS["wave"])
    np.testing.assert_array_equal(frame.data, before)


def test_a_frame_that_is_too_long_is_refused(renderer: Renderer):
    """The caller learns which size would do, and the renderer serves on."""
    with pytest.raises(InvalidFrame, match="Allowed: 1 to"):
        rendered(renderer, noise_frame(PixelFormat.GRAY8, 40_000, 1), GRIDS["wave"])
    frame = noise_frame(PixelFormat.GRAY8, 40, 10)
    np.testing.assert_array_equal(rendered(renderer, frame, Grid.identity()), frame.data)
