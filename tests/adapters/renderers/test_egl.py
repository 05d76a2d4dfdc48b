from __future__ import annotations

import os

import numpy as np
import pytest

from unbend_service.adapters.renderers.egl import EglRenderer
from unbend_service.domain.errors import RendererUnavailable
from unbend_service.domain.frames import BLACK, Frame, PixelFormat
from unbend_service.domain.grid import Grid

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
