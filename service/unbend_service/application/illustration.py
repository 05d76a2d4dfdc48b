"""Illustrate: one picture in, a figure of what was estimated of it out."""

from __future__ import annotations

from dataclasses import dataclass, replace

from unbend_service.application.blocking import BlockingWork
from unbend_service.application.correction import WRITTEN_FORMATS, Correction, CorrectOptions, leaves_alone
from unbend_service.application.estimation import Estimation
from unbend_service.application.exhibit import Exhibit, Subject
from unbend_service.application.ports import DecodedImage, GridStore, Illustrator, ImageCodec
from unbend_service.domain.errors import InvalidOption
from unbend_service.domain.frames import Frame
from unbend_service.domain.records import GridRecord

SVG = "svg"
FIGURE_FORMATS = (*WRITTEN_FORMATS, SVG)


@dataclass(frozen=True, slots=True)
class Illustrated:
    """An encoded picture and the record that it shows."""

    body: bytes
    image_format: str
    record: GridRecord


class Illustration:
    """Decodes, estimates unless a grid is named, corrects where the figure shows it, draws, encodes."""

    def __init__(
        self,
        estimation: Estimation,
        correction: Correction,
        codec: ImageCodec,
        store: GridStore,
        illustrator: Illustrator,
        blocking: BlockingWork,
        *,
        jpeg_quality: int,
    ) -> None:
        self._estimation = estimation
        self._correction = correction
        self._codec = codec
        self._store = store
        self._illustrator = illustrator
        self._blocking = blocking
        self._jpeg_quality = jpeg_quality

    async def of_image(
        self, body: bytes, subject: Subject, options: CorrectOptions, *, given: GridRecord | None = None
    ) -> Illustrated:
        """Draws ``subject``; the format stays unless another is named (png for one not written).

        Args:
            options: of the estimate, and of the corrected picture in figures that show it; ``image_format`` may be
                ``svg`` as well.
            given: what is known already, instead of an estimate.

        Raises:
            EmptyBody, UnsupportedMediaType, InvalidImage, TooManyPixels, GridNotFound, QueueFull, FoldedGrid.
            DeadlineExceeded, RendererUnavailable, PoisonFrame, Draining: of figures that show the corrected picture.
            InvalidOption: a format that is not written, or guides of a grid that has none.
        """
        if options.image_format not in (None, *FIGURE_FORMATS):
            raise InvalidOption(f"format={options.image_format!r} is not written.", allowed=", ".join(FIGURE_FORMATS))
        image = await self._blocking.run("decode", self._codec.decode, body)
        record = given or await self._record(body, options)
        if subject is Subject.GUIDES and record.guides is None:
            raise InvalidOption(f"The grid {record.id} has no guides.", allowed="grid or displacement")
        exhibit = await self._exhibit(image.frame, subject, record, options)
        chosen = options.image_format or (image.image_format if image.image_format in WRITTEN_FORMATS else "png")
        if chosen == SVG:
            return Illustrated(
                await self._blocking.run("render", self._illustrator.vector, subject, exhibit), SVG, record
            )
        drawn = await self._blocking.run("render", self._illustrator.raster, subject, exhibit)
        encoded = await self._encoded(image, drawn, chosen, options.quality)
        return Illustrated(encoded, chosen, record)

    async def _record(self, body: bytes, options: CorrectOptions) -> GridRecord:
        if options.grid_id is not None:
            return await self._store.get(options.grid_id)
        return await self._estimation.of_image(body, options.correct, min_confidence=options.min_confidence)

    async def _exhibit(self, frame: Frame, subject: Subject, record: GridRecord, options: CorrectOptions) -> Exhibit:
        exhibit = Exhibit(frame, record.grid, record.guides)
        if not subject.shows_result:
            return exhibit
        straight = await self._correction.render(frame, record, options)
        drawn = record.grid if leaves_alone(record) else await self._correction.fitted(record, options)
        return replace(exhibit, straight=straight, drawn=drawn)

    async def _encoded(self, image: DecodedImage, drawn: Frame, chosen: str, quality: int | None) -> bytes:
        wanted = self._jpeg_quality if quality is None else quality
        return await self._blocking.run("encode", self._codec.encode, replace(image, frame=drawn), chosen, wanted)
