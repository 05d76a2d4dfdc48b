"""Makes the pictures of the documentation with Unbend itself.

``python docs/figures.py`` draws the figures of docs/how-it-works.md from docs/pictures/bent.jpg.
``python docs/figures.py --photo PHOTO`` makes bent.jpg and straight.jpg anew first: the photograph is bent by a known
lens (division model), then straightened by the service, which is told nothing.
"""

from __future__ import annotations

import argparse
import asyncio
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from unbend_service.application.correction import CorrectOptions
from unbend_service.application.exhibit import Subject
from unbend_service.application.service import Service
from unbend_service.cli.private import private_service
from unbend_service.domain.fit import CROP, Fit
from unbend_service.domain.frames import BLACK, Frame, PixelFormat
from unbend_service.domain.grid import Grid
from unbend_service.settings import Settings

PICTURES = Path(__file__).parent / "pictures"
#: Division model coefficient in the frame where the half diagonal of the picture is 1.
BEND = 0.3
#: Width of a figure, and its share of JPEG's quality: what keeps it under 200 kB.
FIGURE_PX, FIGURE_QUALITY = 840, 80


async def make_pair(service: Service, photo: Path) -> None:
    """Writes bent.jpg and straight.jpg."""
    image = cv2.cvtColor(cv2.imread(str(photo)), cv2.COLOR_BGR2RGB)
    image = cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    height, width = image.shape[:2]
    aspect = np.array([width, height]) / np.hypot(width, height)

    def bend(target: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Where the bent picture's points come from in the straight one: undistorted = distorted / (1 - b r^2)."""
        radius_squared = ((target * aspect) ** 2).sum(axis=-1, keepdims=True)
        return np.asarray(target * (1 - BEND) / (1 - BEND * radius_squared))

    frame = Frame(PixelFormat.RGB24, width, height, np.ascontiguousarray(image).ravel())
    bent = await service.pool.render(frame, Grid.from_map(bend), BLACK)
    pixels = cv2.cvtColor(bent.reshape(height, width, 3), cv2.COLOR_RGB2BGR)
    body = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()
    result = await service.correction.of_image(body, CorrectOptions(fit=CROP))
    PICTURES.mkdir(exist_ok=True)
    (PICTURES / "bent.jpg").write_bytes(body)
    (PICTURES / "straight.jpg").write_bytes(result.body)
    print(f"{result.record.outcome}: confidence {result.record.confidence:.2f}, grid {result.record.id}")


async def draw_figures(service: Service) -> None:
    """Writes guides.jpg, grid.jpg, grid-straight.jpg and displacement.jpg, all of bent.jpg."""
    image = cv2.imread(str(PICTURES / "bent.jpg"))
    scale = FIGURE_PX / image.shape[1]
    image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    body = cv2.imencode(".png", image)[1].tobytes()
    for subject in (Subject.GUIDES, Subject.GRID, Subject.DISPLACEMENT):
        drawn = await service.illustration.of_image(body, subject, CorrectOptions())
        _write(f"{subject.value}.jpg", drawn.body)
    # the same lattice once it is straight, in the frame in which it was estimated
    straight = await service.correction.of_image(body, CorrectOptions(fit=Fit.parse("keep")))
    regular = await service.grids.put_grid(Grid.identity())
    drawn = await service.illustration.of_image(straight.body, Subject.GRID, CorrectOptions(grid_id=regular.id))
    _write("grid-straight.jpg", drawn.body)


def _write(name: str, body: bytes) -> None:
    image = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR)
    cv2.imwrite(str(PICTURES / name), image, [cv2.IMWRITE_JPEG_QUALITY, FIGURE_QUALITY])


async def main(photo: Path | None) -> None:
    """Every picture that is asked for, by one service."""
    async with private_service(Settings(workers=1)) as service:
        if photo is not None:
            await make_pair(service, photo)
        await draw_figures(service)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photo", type=Path, help="makes the pair of the README from it first")
    asyncio.run(main(parser.parse_args().photo))
