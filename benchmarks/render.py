"""The pool beside bare cv2.remap, and EGL through the pool beside a bare moderngl loop."""

from __future__ import annotations

import argparse
import asyncio
import fcntl
import itertools
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import cv2
import moderngl
import numpy as np

from benchmarks.material import BareRemap, barrel_grid, frames
from benchmarks.measurement import Report, by_turns
from unbend_service.adapters.cores import usable_cores
from unbend_service.adapters.metrics.prometheus import PrometheusMeter
from unbend_service.adapters.renderers.mesh import mesh_triangles, mesh_vertices
from unbend_service.adapters.renderers.pool import WorkerPool
from unbend_service.application.ports import Bytes, SharedPicture
from unbend_service.domain.errors import RendererUnavailable
from unbend_service.domain.frames import BLACK, Frame, PixelFormat
from unbend_service.domain.grid import Grid
from unbend_service.settings import Settings

BAR = 1.10
BAR_PACKED = 1.15
#: Width, height and microseconds a frame on the paper's NVIDIA K80.
PAPER = ((256, 256, 273), (1920, 1080, 7_542), (4450, 2000, 26_489))
BARRED = ((1920, 1080), (4450, 2000))
FORMATS = (PixelFormat.RGBA, PixelFormat.I420, PixelFormat.RGB24, PixelFormat.NV12)
IN_FLIGHT = 6
FRAMES = 6


class Pool:
    """A running pool that a synchronous suite can call."""

    def __init__(self, renderer: str, workers: int) -> None:
        settings = Settings.model_validate({"renderer": renderer, "workers": workers, "render_deadline_s": 120})
        self._runner = asyncio.Runner()
        self._pool = WorkerPool(settings, PrometheusMeter())
        self._runner.run(self._pool.start())
        self.device = self._runner.run(self._all_ready())

    async def _all_ready(self) -> str:
        """Waits for every worker; returns the device."""
        while any(worker.state == "starting" for worker in self._pool.state().workers):  # noqa: ASYNC110 no event says so
            await asyncio.sleep(0.05)
        info = self._pool.state().renderer
        return info.device if info is not None else "unknown"

    def one(self, frame: Frame, grid: Grid, shared: SharedPicture | None = None) -> float:
        """One frame, alone in the pool; seconds until its answer, as seen on the event loop, where the service is."""
        return self._runner.run(self._render(frame, grid, shared))

    def shared(self, batch: list[Frame]) -> Iterator[tuple[Frame, SharedPicture]]:
        """The frames, copied into memory that this process shares with the pool, and room for an answer to each."""
        size = batch[0].data.size
        fd = os.memfd_create("benchmark", os.MFD_ALLOW_SEALING)
        os.ftruncate(fd, 2 * len(batch) * size)
        fcntl.fcntl(fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)
        memory = self._pool.adopt(fd, 2 * len(batch) * size)
        for n, frame in enumerate(batch):
            first, middle, end = (size * (2 * n + k) for k in range(3))
            source, target = memory.memory[first:middle], memory.memory[middle:end]
            source[:] = frame.data
            yield replace(frame, data=source), SharedPicture(memory, first, middle, source, target)

    def many(self, batch: list[Frame], grid: Grid, in_flight: int = IN_FLIGHT) -> None:
        """All frames, ``in_flight`` at a time."""
        self._runner.run(self._flow(batch, grid, in_flight))

    async def _render(self, frame: Frame, grid: Grid, shared: SharedPicture | None) -> float:
        start = time.perf_counter()
        await self._pool.render(frame, grid, BLACK, shared=shared)
        return time.perf_counter() - start

    async def _flow(self, batch: list[Frame], grid: Grid, in_flight: int) -> None:
        waiting = iter(batch)

        async def take() -> None:
            for frame in waiting:
                await self._pool.render(frame, grid, BLACK)

        await asyncio.gather(*(take() for _ in range(in_flight)))

    def close(self) -> None:
        self._runner.run(self._pool.close(1.0))
        self._runner.close()


class BareDraw:
    """The peer of EGL: upload, draw and read back with moderngl, nothing around it; in this very process."""

    def __init__(self, width: int, height: int, grid: Grid) -> None:
        egl = {"backend": "egl"}
        self._context = moderngl.create_context(require=330, standalone=True, **egl)  # type: ignore[arg-type]  # stubs type every setting alike
        self._program = self._context.program(
            vertex_shader="#version 330 core\nin vec2 target; in vec2 displacement; out vec2 place;\n"
            "void main() { gl_Position = vec4(target, 0, 1); place = (target + displacement) * 0.5 + 0.5; }",
            fragment_shader="#version 330 core\nin vec2 place; uniform sampler2D image; out vec4 colour;\n"
            "void main() { colour = textureLod(image, place, 0.0); }",
        )
        points = mesh_vertices(grid)
        corners = mesh_triangles(*points.shape[:2])
        self._array = self._context.vertex_array(
            self._program,
            [(self._context.buffer(points), "2f 2f", "target", "displacement")],
            self._context.buffer(corners),
            index_element_size=4,
        )
        self._texture = self._context.texture((width, height), 4)
        self._framebuffer = self._context.framebuffer([self._context.renderbuffer((width, height), 4)])

    def __call__(self, frame: Frame) -> Bytes:
        drawn = np.empty(frame.data.size, np.uint8)
        self._texture.write(frame.data)
        self._framebuffer.use()
        self._texture.use(0)
        self._array.render(moderngl.TRIANGLES)
        self._framebuffer.read_into(drawn, components=4, alignment=1)
        return drawn

    def close(self) -> None:
        self._context.release()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the suite."""
    parser.add_argument("--runs", type=int, default=40, help="turns a case")


def run(arguments: argparse.Namespace) -> Report:
    """Every case, each against its peer."""
    report = Report("render")
    runs = 2 if arguments.quick else arguments.runs
    _cpu(report, runs, arguments.quick)
    _egl(report, max(2, runs // 3), arguments.quick)
    return report


def _cpu(report: Report, runs: int, quick: bool) -> None:
    grid, cores = barrel_grid(), usable_cores()
    cv2.setNumThreads(cores)
    sizes = PAPER[:1] if quick else PAPER
    pool = Pool("cpu", 1)
    try:
        for (width, height, k80_us), pixel_format in itertools.product(sizes, FORMATS):
            turn, peer = _cases(pixel_format, width, height, grid, pool.one)
            pair = by_turns(turn, peer, runs)
            name = f"cpu pool, one frame at a time, {pixel_format} {width}x{height}"
            report.add_pair(name, pair, peer_name="cv2.remap", threads=cores, paper_k80_us=k80_us)
            if (width, height) in BARRED:
                report.add_ratio(f"{name} / cv2.remap", pair.ratio, at_most=BAR)
        for (width, height), pixel_format in itertools.product(((256, 256),) if quick else BARRED, FORMATS[:2]):
            batch = frames(pixel_format, width, height, FRAMES)
            bare = BareRemap(batch[0], grid)
            source, lying = itertools.cycle(batch), itertools.cycle(pool.shared(batch))
            pair = by_turns(
                lambda lying=lying: pool.one((there := next(lying))[0], grid, there[1]),  # type: ignore[misc]  # mypy cannot infer a bound argument
                lambda source=source, bare=bare: bare(next(source)),  # type: ignore[misc]  # as above
                runs,
            )
            name = f"cpu pool, one frame at a time, {pixel_format} {width}x{height} in shared memory"
            report.add_pair(name, pair, peer_name="cv2.remap", threads=cores)
            report.add_ratio(f"{name} / cv2.remap", pair.ratio, at_most=BAR)
        for width, height in () if quick else BARRED:
            packed, wide = (frames(kind, width, height, FRAMES) for kind in (PixelFormat.RGB24, PixelFormat.RGBA))
            three, four = _each(packed, grid, pool.one), _each(wide, grid, pool.one)
            pair = by_turns(three, four, runs)
            report.add_pair(f"cpu pool, rgb24 {width}x{height}", pair, peer_name="cpu pool, rgba", threads=cores)
            report.add_ratio(f"cpu pool rgb24 / rgba, {width}x{height}", pair.ratio, at_most=BAR_PACKED)
    finally:
        pool.close()
    pool = Pool("cpu", cores)
    try:
        for (width, height), pixel_format in itertools.product(((256, 256),) if quick else BARRED, FORMATS):
            batch = frames(pixel_format, width, height, 2 * IN_FLIGHT)
            bare = BareRemap(batch[0], grid)
            pair = by_turns(
                lambda batch=batch: pool.many(batch, grid),  # type: ignore[misc]  # mypy cannot infer a bound argument
                lambda batch=batch, bare=bare: [bare(frame) for frame in batch],  # type: ignore[misc]  # as above
                max(2, runs // 3),
                warm_up=2,
            )
            name = f"cpu pool, {IN_FLIGHT} frames in flight, {pixel_format} {width}x{height}"
            report.add_pair(name, pair.per(len(batch)), peer_name="cv2.remap", threads=cores, workers=cores)
            report.add_ratio(f"{name} / cv2.remap", pair.ratio, at_most=BAR)
    finally:
        pool.close()


def _egl(report: Report, runs: int, quick: bool) -> None:
    grid = barrel_grid()
    try:
        pool = Pool("egl", 1)
    except RendererUnavailable as error:
        print(f"egl is left out: {error}", flush=True)
        return
    try:
        for width, height, k80_us in PAPER[:1] if quick else PAPER:
            source = itertools.cycle(frames(PixelFormat.RGBA, width, height, FRAMES))
            bare = BareDraw(width, height, grid)
            pair = by_turns(
                lambda source=source: pool.one(next(source), grid),  # type: ignore[misc]  # as above
                lambda source=source, bare=bare: bare(next(source)),  # type: ignore[misc]  # as above
                runs,
            )
            bare.close()
            name = f"egl pool, one frame at a time, rgba {width}x{height}"
            report.add_pair(name, pair, peer_name="moderngl", device=pool.device, paper_k80_us=k80_us)
            if (width, height) in BARRED:
                report.add_ratio(f"{name} / moderngl", pair.ratio, at_most=BAR)
    finally:
        pool.close()


def _cases(
    pixel_format: PixelFormat, width: int, height: int, grid: Grid, render: Callable[[Frame, Grid], object]
) -> tuple[Callable[[], object], Callable[[], object]]:
    """One frame through ``render``, and the next one through bare remap."""
    batch = frames(pixel_format, width, height, FRAMES)
    bare = BareRemap(batch[0], grid)
    source = itertools.cycle(batch)
    return _each(batch, grid, render), lambda: bare(next(source))


def _each(batch: list[Frame], grid: Grid, render: Callable[[Frame, Grid], object]) -> Callable[[], object]:
    source = itertools.cycle(batch)
    return lambda: render(next(source), grid)
