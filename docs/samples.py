"""Makes the sample pictures of the page: ``python docs/samples.py``.

The shop front is the README's CC0 photograph, smaller; the facade is drawn here and bent into a pincushion, so that the
two samples are bent opposite ways.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from unbend_service.domain.maps import pixel_centres

DOCS = Path(__file__).parent
SAMPLES = DOCS.parent / "service/unbend_service/web/samples"
WIDTH, HEIGHT = 960, 640
#: Division model coefficient in the frame where the half diagonal of the picture is 1.
BEND = -0.16


def draw_facade(width: int = WIDTH, height: int = HEIGHT, seed: int = 5) -> npt.NDArray[np.uint8]:
    """(height, width, 3) uint8 BGR: a brick front with windows, cornices and a door; straight."""
    rng = np.random.default_rng(seed)
    scale = 3
    wide, high = width * scale, height * scale
    image = np.full((high, wide, 3), (178, 196, 214), np.uint8)
    brick_height, brick_width = high // 64, wide // 40
    for row in range(high // brick_height + 1):
        for column in range(-1, wide // brick_width + 1):
            left = column * brick_width + (brick_width // 2) * (row % 2)
            shade = rng.normal(0, 7)
            colour = tuple(float(np.clip(c + shade, 0, 255)) for c in (96, 124, 172))
            top = row * brick_height
            cv2.rectangle(image, (left + 3, top + 3), (left + brick_width - 3, top + brick_height - 3), colour, -1)
    storeys, bays = 4, 6
    for storey in range(storeys):
        top = high * storey // storeys
        cv2.rectangle(image, (0, top), (wide, top + high // 40), (205, 214, 222), -1)
        cv2.rectangle(image, (0, top + high // 40), (wide, top + high // 40 + 9), (110, 120, 130), -1)
        for bay in range(bays):
            _draw_window(image, rng, wide * bay // bays, top, wide // bays, high // storeys)
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _draw_window(
    image: npt.NDArray[np.uint8], rng: np.random.Generator, left: int, top: int, wide: int, high: int
) -> None:
    x0, x1, y0, y1 = left + wide // 4, left + wide * 3 // 4, top + high // 4, top + high * 7 // 8
    cv2.rectangle(image, (x0 - 18, y0 - 18), (x1 + 18, y1 + 18), (216, 224, 230), -1)
    sky = rng.uniform(0.35, 0.75)
    for line in range(y0, y1):
        share = (line - y0) / (y1 - y0)
        colour = np.array([120, 96, 70]) * (1 - share * 0.5) * sky + 40
        cv2.line(image, (x0, line), (x1, line), colour.tolist(), 1)
    middle_x, middle_y = (x0 + x1) // 2, y0 + (y1 - y0) // 3
    cv2.rectangle(image, (middle_x - 6, y0), (middle_x + 6, y1), (226, 232, 236), -1)
    cv2.rectangle(image, (x0, middle_y - 6), (x1, middle_y + 6), (226, 232, 236), -1)
    cv2.rectangle(image, (x0 - 30, y1 + 18), (x1 + 30, y1 + 36), (196, 206, 214), -1)


def bend(picture: npt.NDArray[np.uint8], strength: float = BEND) -> npt.NDArray[np.uint8]:
    """The picture as a lens of the division model would show it; (height, width, 3) uint8."""
    height, width = picture.shape[:2]
    aspect = np.array([width, height]) / np.hypot(width, height)
    target = np.stack(np.meshgrid(pixel_centres(width), pixel_centres(height)), axis=-1)
    radius_squared = ((target * aspect) ** 2).sum(axis=-1, keepdims=True)
    source = target * min(1.0, 1 - strength) / (1 - strength * radius_squared)
    pixels = ((source + 1) / 2 * (width, height) - 0.5).astype(np.float32)
    bent = cv2.remap(picture, pixels[..., 0], pixels[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(bent, dtype=np.uint8)


def main() -> None:
    """Writes both samples."""
    SAMPLES.mkdir(exist_ok=True)
    photo = np.asarray(cv2.imread(str(DOCS / "pictures/bent.jpg")), dtype=np.uint8)
    small = np.asarray(cv2.resize(photo, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    for name, picture in (("shopfront", small), ("facade", bend(draw_facade()))):
        cv2.imwrite(str(SAMPLES / f"{name}.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, 82])


if __name__ == "__main__":
    main()
