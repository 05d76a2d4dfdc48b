"""Makes the README's pictures with Unbend itself: ``python docs/figures.py PHOTO``.

The photograph is bent by a known lens (division model), then straightened by the service, which is told nothing.
"""

from __future__ import annotations

import argparse
import asyncio
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from unbend_service.application.correction import CorrectOptions
from unbend_service.cli.private import private_service
from unbend_service.domain.fit import CROP
from unbend_service.domain.frames import BLACK, Frame, PixelFormat
from unbend_service.domain.grid import Grid
from unbend_service.settings import Settings

PICTURES = Path(__file__).parent / "pictures"
#: Division model coefficient in the frame where the half diagonal of the picture is 1.
BEND = 0.22


async def make(photo: Path) -> None:
    """Writes bent.jpg and straight.jpg."""
    image = cv2.cvtColor(cv2.imread(str(photo)), cv2.COLOR_BGR2RGB)
    image = cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    height, width = image.shape[:2]
    aspect = np.array([width, height]) / np.hypot(width, height)

    def bend(target: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Where the bent picture's points come from in the straight one: undistorted = distorted / (1 - b r^2)."""
        radius_squared = ((target * aspect) ** 2).sum(axis=-1, keepdims=True)
        return np.asarray(target * (1 - BEND) / (1 - BEND * radius_squared))

    async with private_service(Settings(workers=1)) as service:
        frame = Frame(PixelFormat.RGB24, width, height, np.ascontiguousarray(image).ravel())
        bent = await service.pool.render(frame, Grid.from_map(bend), BLACK)
        pixels = cv2.cvtColor(bent.reshape(height, width, 3), cv2.COLOR_RGB2BGR)
        body = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()
        result = await service.correction.of_image(body, CorrectOptions(fit=CROP))
    PICTURES.mkdir(exist_ok=True)
    (PICTURES / "bent.jpg").write_bytes(body)
    (PICTURES / "straight.jpg").write_bytes(result.body)
    print(f"{result.record.outcome}: confidence {result.record.confidence:.2f}, grid {result.record.id}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("photo", type=Path)
    asyncio.run(make(parser.parse_args().photo))
