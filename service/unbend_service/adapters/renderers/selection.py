"""Which renderer a worker runs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2

from unbend_service.adapters.renderers.cpu import CpuRenderer
from unbend_service.application.ports import Renderer
from unbend_service.domain.errors import RendererUnavailable


@dataclass(frozen=True, slots=True)
class RendererOptions:
    """What a worker is told about its renderer.

    Attributes:
        renderer: ``egl``, ``cpu``, or ``auto``: EGL where it gives a hardware GPU, else cpu.
        require_gpu: a software renderer will not do.
        threads: CPU threads that one frame may use.
        egl_device: which EGL device, counted as the driver lists them.
        map_cache_bytes: bound on the sampling maps or meshes that are kept.
    """

    renderer: Literal["auto", "egl", "cpu"] = "auto"
    require_gpu: bool = False
    threads: int = 1
    egl_device: int = 0
    map_cache_bytes: int = 256 << 20


def open_renderer(options: RendererOptions) -> Renderer:
    """Opens the renderer that ``options`` ask for; sets the threads of OpenCV for the whole process.

    Raises:
        RendererUnavailable: it is not there, or a GPU is required and missing.
    """
    cv2.setNumThreads(options.threads)
    if options.renderer == "cpu":
        if options.require_gpu:
            raise RendererUnavailable(
                "A GPU is required, and the cpu renderer was chosen.",
                allowed="renderer egl or auto",
                setting="renderer",
            )
        return CpuRenderer(options.map_cache_bytes)
    # imported here so that a node without OpenGL needs neither the library nor its time to load
    from unbend_service.adapters.renderers.egl import EglRenderer

    try:
        renderer = EglRenderer(options.egl_device, options.map_cache_bytes)
    except RendererUnavailable:
        if options.renderer == "egl" or options.require_gpu:
            raise
        return CpuRenderer(options.map_cache_bytes)
    if renderer.info.hardware or (options.renderer == "egl" and not options.require_gpu):
        return renderer
    device = renderer.info.device
    renderer.close()
    if options.require_gpu:
        raise RendererUnavailable(
            f"A GPU is required, and EGL gives only the software renderer {device}.", setting="require_gpu"
        )
    return CpuRenderer(options.map_cache_bytes)
