"""What is done with one frame of a stream."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from unbend_service.application.blocking import BlockingWork
from unbend_service.application.correction import Correction
from unbend_service.application.ports import DecodedImage, ImageCodec, Meter
from unbend_service.application.stream_grid import FixedGrid, StreamGrid
from unbend_service.application.stream_messages import (
    EncodedFormat,
    FrameStatus,
    RawFormat,
    StreamConfig,
    StreamFrame,
    StreamResult,
    WhileEstimating,
)
from unbend_service.application.turns import Turns
from unbend_service.domain.errors import BodyTooLarge, InvalidFrame, Unavailable, UnbendError
from unbend_service.domain.frames import Frame
from unbend_service.domain.grid import Grid
from unbend_service.settings import Settings


@dataclass(frozen=True, slots=True)
class FrameAnswers:
    """Answers the frames of one stream, one by one and side by side."""

    stream_id: str
    config: StreamConfig
    grid: StreamGrid
    correction: Correction
    codec: ImageCodec
    blocking: BlockingWork
    meter: Meter
    turns: Turns
    settings: Settings

    async def of_frame(self, frame: StreamFrame, fixed: FixedGrid | None) -> StreamResult:
        """The answer to a frame that was started when the grid was ``fixed`` (None: not yet).

        An error of the frame is an answer. Raised are errors of the stream: the grid is impossible, or nothing can be
        rendered any more (Unavailable).
        """
        try:
            picture = await self._picture(frame, fixed)
        except Unavailable:
            raise
        except UnbendError as error:
            return self._failed(frame, error)
        if fixed is None and self.config.while_estimating is WhileEstimating.HOLD:
            fixed = await self.grid.fixed()
        if fixed is None or fixed.fitted is None:
            self.meter.frame("passed_through" if fixed is None else "left_alone")
            return StreamResult(frame.index, frame.timestamp_us, FrameStatus.PASSED_THROUGH, frame.data)
        try:
            data = await self._corrected(picture, fixed.fitted)
        except Unavailable:
            raise
        except UnbendError as error:
            return self._failed(frame, error)
        self.meter.frame("corrected")
        return StreamResult(frame.index, frame.timestamp_us, FrameStatus.CORRECTED, data)

    async def _picture(self, frame: StreamFrame, fixed: FixedGrid | None) -> DecodedImage | Frame:
        """The picture of a frame, offered for the estimate if the grid is open.

        Frames that will come back as they are are decoded all the same: a broken one is answered as failed whether
        the stream is corrected or not.
        """
        if fixed is not None:
            return await self._decoded(frame)
        try:
            picture = await self._decoded(frame)
        except BaseException:
            self.grid.lose()
            raise
        await self.grid.offer(picture if isinstance(picture, Frame) else picture.frame)
        return picture

    async def _decoded(self, frame: StreamFrame) -> DecodedImage | Frame:
        match self.config.frame_format:
            case RawFormat(pixel_format, width, height):
                return Frame(pixel_format, width, height, np.frombuffer(frame.data, np.uint8))
            case EncodedFormat(image_format):
                return await self._decoded_file(frame.data, image_format)

    async def _decoded_file(self, body: bytes, image_format: str) -> DecodedImage:
        bound = self.settings.body_bytes
        if len(body) > bound:
            raise BodyTooLarge(f"A frame of {len(body)} bytes.", allowed=f"{bound} bytes", setting="body_bytes")
        image = await self.turns.run(lambda: self.blocking.run("decode", self.codec.decode, body))
        if image.image_format != image_format:
            raise InvalidFrame(f"A {image.image_format} file in a stream of {image_format} files.")
        return image

    async def _corrected(self, picture: DecodedImage | Frame, grid: Grid) -> bytes:
        frame = picture if isinstance(picture, Frame) else picture.frame
        border = self.config.options.border
        data = await self.turns.run(lambda: self.correction.draw(frame, grid, border, affinity=self.stream_id))
        if isinstance(picture, Frame):
            return data.tobytes()
        drawn = replace(picture, frame=replace(frame, data=data))
        return await self.turns.run(lambda: self.correction.encode(drawn, drawn.image_format, self.config.options))

    def _failed(self, frame: StreamFrame, error: UnbendError) -> StreamResult:
        self.meter.frame("failed")
        return StreamResult(frame.index, frame.timestamp_us, FrameStatus.FAILED, error=error)
