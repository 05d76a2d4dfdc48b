"""Do the egl and the cpu renderer give the same pictures? PSNR over a folder of photographs."""

from __future__ import annotations

import argparse
import asyncio
from contextlib import AsyncExitStack
from pathlib import Path

import numpy as np

from unbend_service.application.correction import CorrectOptions
from unbend_service.application.fitting import fitted
from unbend_service.application.service import Service
from unbend_service.cli.private import private_service
from unbend_service.domain.fit import CROP, FULL, Fit
from unbend_service.domain.frames import Frame
from unbend_service.domain.grid import Grid
from unbend_service.domain.maps import Float64, pixel_centres
from unbend_service.settings import Settings

BAR_DB = 45.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the suite."""
    parser.add_argument("--photos", type=Path, required=True, help="folder of photographs, searched below")
    parser.add_argument("--limit", type=int, default=10, help="photographs, spread evenly over the folder")


def run(arguments: argparse.Namespace) -> int:
    """Prints one line a photograph and the worst figure; 1 if that is below the bar."""
    found = sorted(path for path in arguments.photos.rglob("*") if path.suffix in (".jpg", ".png"))
    photographs = found[:: max(1, len(found) // arguments.limit)][: arguments.limit]
    if not photographs:
        print(f"no photographs below {arguments.photos}")
        return 2
    worst = asyncio.run(_compare(photographs))
    print(f"worst PSNR {worst:.1f} dB, bar {BAR_DB:.0f} dB: {'ok' if worst >= BAR_DB else 'MISSED'}")
    return 0 if worst >= BAR_DB else 1


async def _compare(photographs: list[Path]) -> float:
    worst = float("inf")
    async with AsyncExitStack() as stack:
        egl = await stack.enter_async_context(private_service(Settings(renderer="egl", workers=1)))
        cpu = await stack.enter_async_context(private_service(Settings(renderer="cpu", workers=1)))
        for service in (egl, cpu):
            info = service.pool.state().renderer
            print(f"renderer {info.name if info else None}: {info.device if info else None}")
        for path in photographs:
            figures = [await _psnr_db(path.read_bytes(), fit, egl, cpu) for fit in (CROP, FULL)]
            print(f"{path.parent.name}/{path.name}: crop {figures[0]:.1f} dB, full {figures[1]:.1f} dB", flush=True)
            worst = min(worst, *figures)
    return worst


async def _psnr_db(body: bytes, fit: Fit, egl: Service, cpu: Service) -> float:
    image = egl.codec.decode(body)
    record = await cpu.estimation.of_image(body)
    if record.grid.displacement == 0:
        record = await cpu.grids.put_grid(Grid.from_map(_barrel))
    await egl.store.put(record)
    options = CorrectOptions(fit=fit, grid_id=record.id)
    first = (await egl.correction.of_frame(image.frame, options)).frame
    second = (await cpu.correction.of_frame(image.frame, options)).frame
    inside = _inside(fitted(record.grid, fit, 1.0), image.frame)
    difference = _pixels(first)[inside] - _pixels(second)[inside]
    return float(10 * np.log10(255**2 / max(float((difference**2).mean()), 1e-9)))


def _barrel(target: Float64) -> Float64:
    """A lens to correct where the estimate leaves the photograph alone: division model, lambda -0.15, centred frame."""
    radius = np.hypot(target[..., 0], target[..., 1])[..., None]
    return np.asarray(target * 2 / (1 + np.sqrt(1 + 0.6 * radius**2)))


def _pixels(frame: Frame) -> Float64:
    return frame.plane_arrays()[0].astype(np.float64)


def _inside(grid: Grid, frame: Frame) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """(height, width) bool: target pixels at least two source pixels inside the source."""
    target = np.stack(np.meshgrid(pixel_centres(frame.width), pixel_centres(frame.height)), axis=-1)
    margin = 1 - 4 / np.array([frame.width, frame.height])
    return np.asarray((np.abs(grid(target)) < margin).all(axis=-1))
