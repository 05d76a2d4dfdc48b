"""EglRenderer: the mesh of the grid drawn with OpenGL, without a display."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any, ClassVar

import moderngl
import numpy as np

from unbend_service.adapters.renderers.mesh import mesh_triangles, mesh_vertices
from unbend_service.adapters.renderers.recent import Recent
from unbend_service.adapters.renderers.sampling import PlaneSampling
from unbend_service.application.ports import Bytes, RendererInfo
from unbend_service.domain.errors import InvalidFrame, RendererUnavailable, RenderFailed
from unbend_service.domain.frames import BLACK, Border, Frame, PixelFormat, Plane, planes
from unbend_service.domain.grid import Grid

_SOFTWARE = ("llvmpipe", "softpipe", "swiftshader", "swrast", "basic render")
_GL_DITHER = 0x0BD0
_MARK_BYTES = 16
_REMEDY = (
    "Install libegl1 and a driver (Mesa: libgl1-mesa-dri; NVIDIA in a container: NVIDIA_DRIVER_CAPABILITIES with "
    "graphics), or set UNBEND_RENDERER=cpu"
)

# Only the displacement is interpolated and added to the exact pixel position: it is small where float32 would be
# coarse, and zero for the identity. Row 0 of textures and framebuffers is the top row of the picture throughout, so
# nothing is ever turned upside down.
_VERTEX_SHADER = """
#version 330 core
in vec2 target;
in vec2 displacement;
uniform vec2 scale;
uniform vec2 extent;
out vec2 offset;
void main() {
    gl_Position = vec4((target + 1.0) * scale - 1.0, 0.0, 1.0);
    offset = displacement * 0.5 * extent;
}
"""
_FRAGMENT_SHADER = """
#version 330 core
in vec2 offset;
uniform sampler2D image;
uniform vec2 per_sample;
out vec4 colour;
void main() {
    colour = textureLod(image, (gl_FragCoord.xy + offset) * per_sample, 0.0);
}
"""
# a shader of its own, because on a software rasteriser the test takes a fifth of the frame
_BORDERED_FRAGMENT_SHADER = """
#version 330 core
in vec2 offset;
uniform sampler2D image;
uniform vec2 per_sample;
uniform vec2 low;
uniform vec2 high;
uniform vec4 border;
out vec4 colour;
void main() {
    vec2 position = gl_FragCoord.xy + offset;
    bool outside = any(lessThan(position, low)) || any(greaterThan(position, high));
    colour = outside ? border : textureLod(image, position * per_sample, 0.0);
}
"""


@dataclass(frozen=True, slots=True)
class _Surface:
    """Texture and framebuffer of one plane, and its pixel buffers where transfers go through them."""

    texture: Any
    framebuffer: Any
    upload: Any = None
    download: Any = None

    def release(self) -> None:
        self.framebuffer.release()
        self.texture.release()
        for buffer in (self.upload, self.download):
            if buffer is not None:
                buffer.release()


@dataclass(frozen=True, slots=True)
class _Surfaces:
    """Those of a frame, plane by plane."""

    planes: tuple[_Surface, ...]

    def release(self) -> None:
        for surface in self.planes:
            surface.release()


@dataclass(frozen=True, slots=True)
class _Mesh:
    vertices: Any
    triangles: Any
    array: Any
    bordered_array: Any

    def release(self) -> None:
        self.array.release()
        self.bordered_array.release()
        self.triangles.release()
        self.vertices.release()


class EglRenderer:
    """Renders with OpenGL 3.3 core on an EGL device; the only place where a context is made, one per process.

    A context can be lost: the driver was reset, or the device is gone. Not every driver says so; some draw nothing
    from then on. So each frame must change a mark that was put into its target, and where it does not, or OpenGL
    reports an error, a small picture is drawn whose outcome is known.

    Cost of a frame: each plane is uploaded, drawn in one pass and read back; a new grid costs its mesh, a new size its
    textures, framebuffers and pixel buffers. On a GPU all planes are handed over before the first is waited for,
    through pixel buffers that stay, so one is drawn while another travels; frames overlap across the workers, each
    with a context of its own. A software renderer would only copy twice: there the transfers are direct.

    Args:
        device: index of the EGL device, as the driver lists them.
        cache_bytes: bound on the meshes, and on the textures, framebuffers and pixel buffers, that are kept.
        pixel_buffers: whether transfers go through pixel buffers; None: on a GPU.

    Raises:
        RendererUnavailable: no OpenGL 3.3 context can be had, or this process has one already.
    """

    _open: ClassVar[bool] = False

    def __init__(self, device: int = 0, cache_bytes: int = 256 << 20, pixel_buffers: bool | None = None) -> None:
        if EglRenderer._open:
            raise RendererUnavailable("This process has an EGL renderer already; close it first.")
        egl: dict[str, Any] = {"backend": "egl", "device_index": device}
        try:
            self._context = moderngl.create_context(require=330, standalone=True, **egl)
        except Exception as error:  # the library raises plain Exception for everything that EGL may lack
            raise RendererUnavailable(
                f"EGL device {device} gives no OpenGL 3.3 context ({error}). {_REMEDY}.", setting="renderer"
            ) from error
        self._context.disable_direct(_GL_DITHER)
        self._longest_px = int(
            min(self._context.info["GL_MAX_TEXTURE_SIZE"], *self._context.info["GL_MAX_VIEWPORT_DIMS"])
        )
        self._program, self._bordered_program = (
            self._context.program(vertex_shader=_VERTEX_SHADER, fragment_shader=shader)
            for shader in (_FRAGMENT_SHADER, _BORDERED_FRAGMENT_SHADER)
        )
        self._surfaces: Recent[tuple[Plane, ...], _Surfaces] = Recent(cache_bytes, _Surfaces.release)
        self._meshes: Recent[str, _Mesh] = Recent(cache_bytes, _Mesh.release)
        self._info = self._describe()
        self._mark = np.frombuffer(os.urandom(_MARK_BYTES), np.uint8)
        self._pixel_buffers = self._info.hardware if pixel_buffers is None else pixel_buffers
        self._closed = False
        EglRenderer._open = True

    @property
    def info(self) -> RendererInfo:
        return self._info

    def _describe(self) -> RendererInfo:
        device = str(self._context.info["GL_RENDERER"])
        return RendererInfo("egl", device, hardware=not any(name in device.lower() for name in _SOFTWARE))

    @property
    def kept_bytes(self) -> int:
        """Bytes of the meshes, textures, framebuffers and pixel buffers that are kept now."""
        return self._surfaces.size_bytes + self._meshes.size_bytes

    def render(self, source: Frame, grid: Grid, border: Border, target: Bytes) -> None:
        """See :class:`~unbend_service.application.ports.Renderer`.

        Raises:
            InvalidFrame: a side is longer than the device can draw.
            RenderFailed: OpenGL reported an error.
            RendererUnavailable: the context is lost, and this renderer with it.
        """
        if max(source.width, source.height) > self._longest_px:
            raise InvalidFrame(
                f"A frame of {source.width}x{source.height} pixels is too large for {self._info.device}.",
                allowed=f"1 to {self._longest_px} pixels on a side",
            )
        mark = target[-_MARK_BYTES:]
        mark[:] = self._mark[: mark.size]
        failure = self._render(source, grid, border, target)
        untouched = np.array_equal(mark, self._mark[: mark.size])
        if failure or untouched:
            if not self._draws():
                raise RendererUnavailable(f"The OpenGL context on {self._info.device} is lost. {failure}".rstrip())
            if failure:
                raise RenderFailed(failure)

    def _render(self, source: Frame, grid: Grid, border: Border, target: Bytes) -> str:
        """Draws; returns what OpenGL had to say against it, if anything."""
        colours = border.samples(source.pixel_format)
        layout = planes(source.pixel_format, source.width, source.height)
        try:
            mesh = self._mesh(grid)
            surfaces = self._surfaces_of(layout)
            for plane, colour, surface in zip(layout, colours, surfaces, strict=True):
                part = slice(plane.offset, plane.offset + plane.size_bytes)
                sampling = PlaneSampling.of(source, plane)
                bordered = not sampling.shows_only_source(grid)
                self._upload(surface, source.data[part])
                self._draw(plane, surface, sampling, mesh, colour, bordered)
                drawn: Any = target[part]
                if surface.download is not None:
                    drawn = surface.download
                    mark = self._mark[: plane.size_bytes]  # what an earlier frame left there must not pass for this one
                    drawn.write(mark, offset=plane.size_bytes - mark.size)
                surface.framebuffer.read_into(drawn, components=plane.channels, alignment=1)
            for plane, surface in zip(layout, surfaces, strict=True):
                if surface.download is not None:  # waits for this plane; those after it are still on their way
                    surface.download.read_into(target[plane.offset : plane.offset + plane.size_bytes])
        except moderngl.Error as error:
            return f"OpenGL could not render the frame: {error}"
        code = self._context.error
        return "" if code == "GL_NO_ERROR" else f"OpenGL reported {code}."

    def _draws(self) -> bool:
        """Whether the context still draws: two small pictures, so that no leftover of the one passes for the other."""
        for level in (85, 170):
            picture = Frame(PixelFormat.GRAY8, 16, 16, np.full(256, level, np.uint8))
            drawn = np.zeros(256, np.uint8)
            if self._render(picture, Grid.identity(2, 2), BLACK, drawn) or not (drawn == level).all():
                return False
        return True

    def _upload(self, surface: _Surface, source: Bytes) -> None:
        if surface.upload is None:
            surface.texture.write(source, alignment=1)
            return
        surface.upload.orphan()  # the driver may still be reading what was there, and need not be waited for
        surface.upload.write(source)
        surface.texture.write(surface.upload, alignment=1)

    def _draw(
        self,
        plane: Plane,
        surface: _Surface,
        sampling: PlaneSampling,
        mesh: _Mesh,
        colour: tuple[int, ...],
        bordered: bool,
    ) -> None:
        uniform = self._bordered_program if bordered else self._program
        uniform["scale"] = tuple(sampling.extent / (plane.width, plane.height))
        uniform["extent"] = tuple(sampling.extent)
        uniform["per_sample"] = 1 / plane.width, 1 / plane.height
        if bordered:
            # OpenGL counts positions from the edge of the first sample, not from its centre
            uniform["low"] = (sampling.valid_low + 0.5,) * 2
            uniform["high"] = tuple(high + 0.5 for high in sampling.valid_high)
            uniform["border"] = tuple(np.array([*colour, 0, 0, 0][:4]) / 255)
        surface.framebuffer.use()
        surface.texture.use(0)
        (mesh.bordered_array if bordered else mesh.array).render(moderngl.TRIANGLES)

    def _surfaces_of(self, layout: tuple[Plane, ...]) -> tuple[_Surface, ...]:
        kept = self._surfaces.get(layout)
        if kept is None:
            copies = 4 if self._pixel_buffers else 2
            size_bytes = copies * sum(plane.size_bytes for plane in layout)
            kept = self._surfaces.put(layout, _Surfaces(tuple(map(self._surface, layout))), size_bytes)
        return kept.planes

    def _surface(self, plane: Plane) -> _Surface:
        size = plane.width, plane.height
        texture = self._context.texture(size, plane.channels, alignment=1)
        texture.filter = moderngl.LINEAR, moderngl.LINEAR
        texture.repeat_x = texture.repeat_y = False
        # three channels need not be drawable in OpenGL 3.3; four always are
        drawn = self._context.renderbuffer(size, 4 if plane.channels == 3 else plane.channels)
        try:
            framebuffer = self._context.framebuffer([drawn])
        finally:
            drawn.release()
        if not self._pixel_buffers:
            return _Surface(texture, framebuffer)
        buffers = (self._context.buffer(reserve=plane.size_bytes, dynamic=True) for _ in range(2))
        return _Surface(texture, framebuffer, *buffers)

    def _mesh(self, grid: Grid) -> _Mesh:
        kept = self._meshes.get(grid.id)
        if kept is not None:
            return kept
        points = mesh_vertices(grid)
        corners = mesh_triangles(*points.shape[:2])
        vertices, triangles = self._context.buffer(points), self._context.buffer(corners)
        layout = [(vertices, "2f 2f", "target", "displacement")]
        arrays = [
            self._context.vertex_array(program, layout, triangles, index_element_size=4)
            for program in (self._program, self._bordered_program)
        ]
        return self._meshes.put(grid.id, _Mesh(vertices, triangles, *arrays), points.nbytes + corners.nbytes)

    def rest(self) -> None:
        """See :class:`~unbend_service.application.ports.Renderer`; what is kept here is bounded by itself."""

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        self._surfaces.clear()
        self._meshes.clear()
        self._program.release()
        self._bordered_program.release()
        self._context.release()
        EglRenderer._open = False
