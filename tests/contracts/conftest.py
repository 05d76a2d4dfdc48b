from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from unbend_service.adapters.renderers.cpu import CpuRenderer
from unbend_service.adapters.renderers.egl import EglRenderer
from unbend_service.domain.errors import RendererUnavailable

#: Small, so that the suite passes the bound and renderers must let go of what they keep.
CACHE_BYTES = 32 << 20


@pytest.fixture(scope="module")
def cpu_renderer() -> Iterator[CpuRenderer]:
    renderer = CpuRenderer(CACHE_BYTES)
    yield renderer
    renderer.close()


@pytest.fixture(scope="module")
def egl_renderer() -> Iterator[EglRenderer]:
    """One context for a module: a process has one. UNBEND_REQUIRE_EGL=1 makes its absence a failure."""
    try:
        renderer = EglRenderer(cache_bytes=CACHE_BYTES)
    except RendererUnavailable as error:
        if os.environ.get("UNBEND_REQUIRE_EGL") == "1":
            raise
        pytest.skip(str(error))
    yield renderer
    renderer.close()


@pytest.fixture(params=["cpu", pytest.param("egl", marks=pytest.mark.egl)])
def renderer(request: pytest.FixtureRequest) -> CpuRenderer | EglRenderer:
    """Each implementation of the port in turn."""
    return request.getfixturevalue(f"{request.param}_renderer")
