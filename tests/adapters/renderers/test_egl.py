from __future__ import annotations

import ctypes
import os

import numpy as np
import pytest

from tests.fakes import RecordingMeter
from unbend_service.adapters.renderers.egl import EglRenderer
from unbend_service.adapters.renderers.pool import WorkerPool
from unbend_service.domain.errors import RendererUnavailable, RenderFailed
from unbend_service.domain.frames import BLACK, Border, Frame, PixelFormat, frame_size_bytes
from unbend_service.domain.grid import Grid
from unbend_service.settings import Settings

pytestmark = pytest.mark.egl


def opened() -> EglRenderer:
    try:
        return EglRenderer()
    except RendererUnavailable as error:
        if os.environ.get("UNBEND_REQUIRE_EGL") == "1":
            raise
        pytest.skip(str(error))


def test_a_process_has_one_context_and_may_open_another_after_it() -> None:
    """A second renderer would draw into the first one's context, so it is refused until that is closed."""
    frame = Frame(PixelFormat.GRAY8, 7, 5, np.arange(35, dtype=np.uint8))
    for _ in range(2):
        renderer = opened()
        with pytest.raises(RendererUnavailable, match="already"):
            EglRenderer()
        target = np.empty_like(frame.data)
        renderer.render(frame, Grid.identity(), BLACK, target)
        np.testing.assert_array_equal(target, frame.data)
        renderer.close()
        renderer.close()


def test_a_lost_context_is_noticed_though_nothing_reports_it() -> None:
    """Without a context the driver draws nothing and says nothing: no stale picture is taken for an answer."""
    renderer = opened()
    frame = Frame(PixelFormat.GRAY8, 64, 48, np.random.default_rng(1).integers(0, 256, 64 * 48, np.uint8))
    target = np.empty_like(frame.data)
    renderer.render(frame, Grid.identity(), BLACK, target)
    egl = ctypes.CDLL("libEGL.so.1")
    for name in ("eglGetCurrentDisplay", "eglGetCurrentContext"):
        getattr(egl, name).restype = ctypes.c_void_p
    display, context = (ctypes.c_void_p(egl.eglGetCurrentDisplay()), ctypes.c_void_p(egl.eglGetCurrentContext()))
    assert egl.eglMakeCurrent(display, None, None, None)
    with pytest.raises(RendererUnavailable, match=r"context .* is lost"):
        renderer.render(frame, Grid.identity(), BLACK, target)
    assert egl.eglMakeCurrent(display, None, None, context)
    renderer.render(frame, Grid.identity(), BLACK, target)
    np.testing.assert_array_equal(target, frame.data)
    renderer.close()


def test_a_software_device_is_not_taken_for_a_gpu() -> None:
    """Mesa's software renderer says so in its name."""
    renderer = opened()
    assert renderer.info.name == "egl"
    assert renderer.info.hardware is not any(n in renderer.info.device for n in ("llvmpipe", "softpipe", "SwiftShader"))
    renderer.close()


def test_a_device_that_is_not_there_says_how_to_mend_it() -> None:
    """The error names the setting and what to install."""
    opened().close()
    with pytest.raises(RendererUnavailable, match=r"EGL device 200 .* Install libegl1"):
        EglRenderer(device=200)


def test_an_error_of_opengl_is_an_error_of_the_frame() -> None:
    """Nothing that OpenGL complains of passes for a picture; the next frame is judged anew."""
    renderer = opened()
    frame = Frame(PixelFormat.GRAY8, 7, 5, np.arange(35, dtype=np.uint8))
    target = np.empty_like(frame.data)
    renderer._context.enable_direct(0xFFFF)  # a switch that does not exist
    with pytest.raises(RenderFailed, match="GL_INVALID_ENUM"):
        renderer.render(frame, Grid.identity(), BLACK, target)
    renderer.render(frame, Grid.identity(), BLACK, target)
    np.testing.assert_array_equal(target, frame.data)
    renderer.close()


@pytest.mark.parametrize("pixel_format", PixelFormat)
def test_pixel_buffers_change_no_pixel(pixel_format: PixelFormat) -> None:
    """What travels through pixel buffers, as on a GPU, is what direct transfers bring: for each format, for odd sizes,
    for frames one after the other, and after another size came between."""
    bent = Grid.from_map(lambda p: p * (1 + 0.12 * (p**2).sum(axis=-1, keepdims=True)))
    random = np.random.default_rng(0)
    frames = [
        Frame(
            pixel_format,
            width,
            height,
            random.integers(0, 256, frame_size_bytes(pixel_format, width, height), np.uint8),
        )
        for width, height in ((64, 36), (64, 36), (33, 17), (64, 36))
    ]
    opened().close()
    pictures = []
    for buffers in (False, True):
        renderer = EglRenderer(pixel_buffers=buffers)
        pictures.append([np.empty_like(frame.data) for frame in frames])
        for frame, target in zip(frames, pictures[-1], strict=True):
            renderer.render(frame, bent, Border(200, 30, 250), target)
        renderer.close()
    for direct, buffered in zip(*pictures, strict=True):
        np.testing.assert_array_equal(direct, buffered)


async def test_workers_render_with_egl() -> None:
    """The pool gives the same picture with EGL in its workers as the renderer does here, and names the device."""
    frame = Frame(PixelFormat.I420, 64, 36, np.random.default_rng(0).integers(0, 256, 3456, np.uint8))
    grid = Grid.from_map(lambda p: p * (1.1 - 0.1 * (p**2).sum(axis=-1, keepdims=True)))
    renderer = opened()
    expected = np.empty_like(frame.data)
    renderer.render(frame, grid, BLACK, expected)
    pool = WorkerPool(Settings(renderer="egl", workers=1), RecordingMeter())
    await pool.start()
    try:
        np.testing.assert_array_equal(await pool.render(frame, grid, BLACK), expected)
        assert pool.state().renderer == renderer.info
    finally:
        await pool.close(1)
        renderer.close()
