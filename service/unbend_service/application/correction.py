"""Correct: one picture in, the straightened picture out."""

from __future__ import annotations

from dataclasses import dataclass, replace

from unbend_service.application.blocking import BlockingWork
from unbend_service.application.estimation import Estimation
from unbend_service.application.fitting import FittedGrids
from unbend_service.application.ports import (
    Bytes,
    DecodedImage,
    GridStore,
    ImageCodec,
    Meter,
    RenderPool,
    SharedPicture,
)
from unbend_service.domain.errors import InvalidOption, NotServedHere, UnbendError
from unbend_service.domain.fit import CROP, Fit
from unbend_service.domain.frames import BLACK, Border, Frame, with_alpha
from unbend_service.domain.grid import Grid
from unbend_service.domain.records import Correct, GridRecord, Outcome

WRITTEN_FORMATS = ("jpeg", "png", "webp")


@dataclass(frozen=True, slots=True)
class CorrectOptions:
    """How a picture is to be corrected.

    Attributes:
        correct, min_confidence, camera: of the estimate; ignored with ``grid_id``.
        fit, strength, border: of the rendering.
        quality: 1..100 for jpeg and webp; None takes the setting.
        image_format: ``jpeg``, ``png`` or ``webp``; None keeps the format of the source (png for one that is not
            written).
        grid_id: a stored grid to be used instead of an estimate.
    """

    correct: Correct = Correct.NONLINEAR
    fit: Fit = CROP
    strength: float = 1.0
    border: Border = BLACK
    quality: int | None = None
    image_format: str | None = None
    grid_id: str | None = None
    min_confidence: float | None = None
    camera: str | None = None


@dataclass(frozen=True, slots=True)
class CorrectedImage:
    """An encoded picture and the grid behind it (before fit and strength)."""

    body: bytes
    image_format: str
    record: GridRecord


@dataclass(frozen=True, slots=True)
class CorrectedFrame:
    """A raw picture and the grid behind it (before fit and strength)."""

    frame: Frame
    record: GridRecord


class Correction:
    """Estimates where no grid is named, fits, and has the pool render."""

    def __init__(
        self,
        estimation: Estimation,
        codec: ImageCodec,
        store: GridStore,
        grids: FittedGrids,
        pool: RenderPool,
        blocking: BlockingWork,
        meter: Meter,
        *,
        jpeg_quality: int,
        deadline_s: float,
        offered: bool = True,
    ) -> None:
        self._estimation = estimation
        self._codec = codec
        self._store = store
        self._grids = grids
        self._pool = pool
        self._blocking = blocking
        self._meter = meter
        self._jpeg_quality = jpeg_quality
        self._deadline_s = deadline_s
        self._offered = offered

    def check_offered(self) -> None:
        """Raises NotServedHere on a node that only estimates."""
        if not self._offered:
            raise NotServedHere("This node estimates only.", allowed="role all or render", setting="role")

    async def of_image(self, body: bytes, options: CorrectOptions) -> CorrectedImage:
        """Corrects an encoded picture.

        A picture that is left alone comes back byte for byte, unless another format was asked for or its orientation
        has to be applied.

        Raises:
            EmptyBody, UnsupportedMediaType, InvalidImage, TooManyPixels, InvalidOption, GridNotFound, QueueFull,
            DeadlineExceeded, PoisonFrame, RendererUnavailable, Draining, NotServedHere.
        """
        self.check_offered()
        if options.image_format not in (None, *WRITTEN_FORMATS):
            raise InvalidOption(f"format={options.image_format!r} is not written.", allowed=", ".join(WRITTEN_FORMATS))
        planes = options.image_format in (None, "jpeg")
        image = await self._blocking.run("decode", self._codec.decode, body, planes=planes)
        source_format = image.image_format
        image_format = options.image_format or (source_format if source_format in WRITTEN_FORMATS else "png")
        if options.border.alpha < 255 and options.fit != CROP:
            if image_format == "jpeg":
                raise InvalidOption("jpeg has no transparency.", allowed="a border colour, or format=png or webp")
            image = replace(image, frame=with_alpha(image.frame))
        record = await self._record_of_image(body, options)
        if image.upright and image_format == source_format and leaves_alone(record):
            self._meter.frame("left_alone")
            return CorrectedImage(body, image_format, record)
        frame = await self.render(image.frame, record, options)
        encoded = await self.encode(replace(image, frame=frame), image_format, options)
        return CorrectedImage(encoded, image_format, record)

    async def of_frame(self, frame: Frame, options: CorrectOptions) -> CorrectedFrame:
        """Corrects a raw picture; raises as :meth:`of_image`."""
        self.check_offered()
        record = await self._record(frame, options)
        return CorrectedFrame(await self.render(frame, record, options), record)

    async def render(
        self, frame: Frame, record: GridRecord, options: CorrectOptions, *, affinity: str | None = None
    ) -> Frame:
        """Renders one frame through a known grid; a record that leaves alone gives the frame back as it is."""
        if leaves_alone(record):
            self._meter.frame("left_alone")
            return frame
        try:
            data = await self.draw(frame, await self.fitted(record, options), options.border, affinity=affinity)
        except UnbendError:
            self._meter.frame("failed")
            raise
        self._meter.frame("corrected")
        return replace(frame, data=data)

    async def fitted(self, record: GridRecord, options: CorrectOptions) -> Grid:
        """The grid of a record as it is rendered: with strength and fit.

        Raises:
            InvalidOption, InvalidGrid, FoldedGrid.
        """
        return await self._grids.get(record.grid, options.fit, options.strength)

    async def draw(
        self,
        frame: Frame,
        grid: Grid,
        border: Border,
        *,
        affinity: str | None = None,
        deadline_s: float | None = None,
        shared: SharedPicture | None = None,
    ) -> Bytes:
        """The picture of a fitted grid, (frame_size_bytes,) uint8; counts nothing, so that it may be tried again."""
        limit_s = self._deadline_s if deadline_s is None else min(deadline_s, self._deadline_s)
        return await self._pool.render(frame, grid, border, affinity=affinity, deadline_s=limit_s, shared=shared)

    async def encode(self, image: DecodedImage, image_format: str, options: CorrectOptions) -> bytes:
        """The file of a picture, jpeg, png or webp."""
        quality = self._jpeg_quality if options.quality is None else options.quality
        return await self._blocking.run("encode", self._codec.encode, image, image_format, quality)

    @property
    def render_workers(self) -> int:
        """Workers that render, whatever they do now."""
        return len(self._pool.state().workers)

    async def _record_of_image(self, body: bytes, options: CorrectOptions) -> GridRecord:
        if options.grid_id is not None:
            return await self._store.get(options.grid_id)
        return await self._estimation.of_image(
            body, options.correct, min_confidence=options.min_confidence, camera=options.camera
        )

    async def _record(self, frame: Frame, options: CorrectOptions) -> GridRecord:
        if options.grid_id is not None:
            return await self._store.get(options.grid_id)
        return await self._estimation.of_frame(
            frame, options.correct, min_confidence=options.min_confidence, camera=options.camera
        )


def leaves_alone(record: GridRecord) -> bool:
    """Whether the record says that the picture stays as it is."""
    return record.outcome is Outcome.LEFT_ALONE
