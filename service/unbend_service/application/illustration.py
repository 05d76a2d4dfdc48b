"""Illustrate: one picture in, the same picture out with what was estimated drawn over it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

from unbend_service.application.blocking import BlockingWork
from unbend_service.application.correction import WRITTEN_FORMATS
from unbend_service.application.estimation import Estimation
from unbend_service.application.ports import GridStore, Illustrator, ImageCodec
from unbend_service.domain.errors import InvalidOption
from unbend_service.domain.frames import Frame
from unbend_service.domain.records import Correct, GridRecord


class Subject(StrEnum):
    """What is drawn over the picture."""

    GUIDES = "guides"
    GRID = "grid"
    DISPLACEMENT = "displacement"


@dataclass(frozen=True, slots=True)
class Illustrated:
    """An encoded picture and the record that it shows."""

    body: bytes
    image_format: str
    record: GridRecord


class Illustration:
    """Decodes, estimates unless a grid is named, draws, encodes."""

    def __init__(
        self,
        estimation: Estimation,
        codec: ImageCodec,
        store: GridStore,
        illustrator: Illustrator,
        blocking: BlockingWork,
        *,
        jpeg_quality: int,
    ) -> None:
        self._estimation = estimation
        self._codec = codec
        self._store = store
        self._illustrator = illustrator
        self._blocking = blocking
        self._jpeg_quality = jpeg_quality

    async def of_image(
        self,
        body: bytes,
        subject: Subject,
        correct: Correct = Correct.NONLINEAR,
        *,
        grid_id: str | None = None,
        image_format: str | None = None,
    ) -> Illustrated:
        """Draws ``subject`` over the picture; the format stays unless another is named (png for one not written).

        Raises:
            EmptyBody, UnsupportedMediaType, InvalidImage, TooManyPixels, GridNotFound, QueueFull.
            InvalidOption: a format that is not written, or guides of a grid that has none.
        """
        if image_format not in (None, *WRITTEN_FORMATS):
            raise InvalidOption(f"format={image_format!r} is not written.", allowed=", ".join(WRITTEN_FORMATS))
        image = await self._blocking.run("decode", self._codec.decode, body)
        if grid_id is not None:
            record = await self._store.get(grid_id)
        else:
            record = await self._estimation.of_image(body, correct)
        drawn = await self._blocking.run("render", self._draw, image.frame, subject, record)
        chosen = image_format or (image.image_format if image.image_format in WRITTEN_FORMATS else "png")
        encoded = await self._blocking.run(
            "encode", self._codec.encode, replace(image, frame=drawn), chosen, self._jpeg_quality
        )
        return Illustrated(encoded, chosen, record)

    def _draw(self, frame: Frame, subject: Subject, record: GridRecord) -> Frame:
        if subject is Subject.GRID:
            return self._illustrator.grid(frame, record.grid)
        if subject is Subject.DISPLACEMENT:
            return self._illustrator.displacement(frame, record.grid)
        if record.guides is None:
            raise InvalidOption(f"The grid {record.id} has no guides.", allowed="what=grid, what=displacement")
        return self._illustrator.guides(frame, record.guides)
