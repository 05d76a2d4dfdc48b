"""draw_scene: chooses what to draw and with which camera, draws it, lights it and photographs it."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import numpy.typing as npt

from training.scenes import HEIGHT_PX, WIDTH_PX
from training.vistas.exteriors import canyon, fronts, steps, suburb
from training.vistas.grounds import sky
from training.vistas.interiors import aisle, corridor, kitchen, living
from training.vistas.materials import span
from training.vistas.raster import Camera, Raster

Float32 = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]
Layout = Callable[[Raster, np.random.Generator], None]

OVERSAMPLING = 2
INDOORS: tuple[Layout, ...] = (living, living, kitchen, aisle, corridor)
OUTDOORS: tuple[Layout, ...] = (suburb, suburb, fronts, canyon, steps)


def draw_scene(rng: np.random.Generator) -> Bytes:
    """A grey picture, uint8 (HEIGHT_PX, WIDTH_PX)."""
    indoors = rng.random() < 0.5
    width, height = WIDTH_PX * OVERSAMPLING, HEIGHT_PX * OVERSAMPLING
    horizon_px = height / 2 + float(rng.normal()) * height * 0.12
    eye = np.array([0.0, span(rng, 1.1, 1.8), 0.0])
    heading = span(rng, -0.7, 0.7) if rng.random() < 0.7 else float(rng.normal() * 0.05)
    camera = Camera(eye, heading, span(rng, 0.5, 1.5) * width, horizon_px)
    light = np.array([float(rng.normal()), abs(float(rng.normal())) + 0.3, float(rng.normal()) - 0.7])
    raster = Raster(width, height, camera, light, span(rng, 0.35, 0.8))
    layouts = INDOORS if indoors else OUTDOORS
    layouts[int(rng.integers(len(layouts)))](raster, rng)
    empty = raster.nearness == 0
    tone = np.where(empty, sky(rng, height, width, horizon_px), _lit(raster, rng, indoors))
    return _photographed(np.asarray(tone, np.float32), raster.nearness, rng)


def _lit(raster: Raster, rng: np.random.Generator, indoors: bool) -> Float32:
    """Corners darker than open places; indoors light that falls off from a lamp or a window."""
    small = cv2.resize(raster.nearness, (WIDTH_PX // 4, HEIGHT_PX // 4), interpolation=cv2.INTER_AREA)
    depth = np.log(1 / np.maximum(small, 1 / 80))
    hollow = depth - cv2.GaussianBlur(depth, (0, 0), float(rng.uniform(2, 8)))
    light = 1 - float(rng.uniform(0, 0.9)) * hollow.clip(0, 0.5)
    if indoors:
        y, x = np.mgrid[-1 : 1 : light.shape[0] * 1j, -1 : 1 : light.shape[1] * 1j]
        for _ in range(int(rng.integers(1, 4))):
            at_x, at_y, reach = rng.normal(0, 0.6), rng.normal(-0.5, 0.4), rng.uniform(0.4, 1.5)
            light = light * (0.75 + rng.uniform(0.2, 0.7) / (1 + ((x - at_x) ** 2 + (y - at_y) ** 2) / reach**2))
    whole = cv2.resize(np.asarray(light, np.float32), raster.tone.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(raster.tone * whole, np.float32)


def _photographed(tone: Float32, nearness: Float32, rng: np.random.Generator) -> Bytes:
    """Defocus by depth, the lens's and the sensor's blur, tone curve, grain, and often JPEG."""
    sigma = float(rng.uniform(0.3, 0.8)) if rng.random() < 0.7 else float(rng.uniform(0.8, 1.5))
    size = (WIDTH_PX, HEIGHT_PX)
    shrunk = cv2.resize(tone, size, interpolation=cv2.INTER_AREA)
    grey_tones = np.asarray(cv2.GaussianBlur(shrunk, (0, 0), sigma), np.float32)
    if rng.random() < 0.25:
        focus, spread = float(np.median(nearness)), float(rng.uniform(2, 8))
        apart = np.abs(cv2.resize(nearness, size, interpolation=cv2.INTER_AREA) - focus) / max(focus, 0.05)
        soft = cv2.GaussianBlur(grey_tones, (0, 0), spread)
        share = cv2.GaussianBlur((apart * float(rng.uniform(0.3, 1.5))).clip(0, 1), (0, 0), 1.5)
        grey_tones = grey_tones + share * (soft - grey_tones)
    low, high = np.percentile(grey_tones[::4, ::4], (1, 99))
    stretched = (grey_tones - low) / max(float(high - low), 0.05) * float(rng.uniform(0.75, 1.1)) + float(
        rng.uniform(0, 0.1)
    )
    grain = rng.normal(0, float(rng.uniform(0, 0.025)), stretched.shape).astype(np.float32)
    grey = np.asarray((((stretched.clip(0, 1) ** float(rng.uniform(0.6, 1.4))) + grain).clip(0, 1) * 255), np.uint8)
    if rng.random() < 0.6:
        _, body = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(45, 96))])
        grey = np.asarray(cv2.imdecode(body, cv2.IMREAD_GRAYSCALE), np.uint8)
    return grey
