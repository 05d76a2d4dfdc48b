"""What is done with one frame of a stream."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, replace

import numpy as np

from unbend_service.application.blocking import BlockingWork
from unbend_service.application.correction import Correction
from unbend_service.application.ports import Bytes, DecodedImage, ImageCodec, Meter, SharedPicture
from unbend_service.application.regions import Regions
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
from unbend_service.domain.errors import BodyTooLarge, DeadlineExceeded, InvalidFrame, Unavailable, UnbendError
from unbend_service.domain.frames import Frame, frame_size_bytes
from unbend_service.domain.grid import Grid
from unbend_service.settings import Settings


@dataclass(frozen=True, slots=True)
class _Picture:
    """A frame's picture, with the file that it came from or the shared memory that it lies in."""

    frame: Frame
    image: DecodedImage | None = None
    shared: SharedPicture | None = None


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
    regions: Regions
    settings: Settings

    async def of_frame(self, frame: StreamFrame, fixed: FixedGrid | None, end_s: float | None = None) -> StreamResult:
        """The answer to a frame that was started when the grid was ``fixed`` (None: not yet).

        An error of the frame is an answer, and so is that it was not done at ``end_s`` of the loop's clock. Raised are
        errors of the stream: the grid is impossible, or nothing can be rendered any more (Unavailable).
        """
        limit = asyncio.timeout_at(end_s)
        try:
            async with limit:
                return await self._answered(frame, fixed, limit)
        except TimeoutError:
            if not limit.expired():
                raise
            return self._failed(frame, _too_late(frame))

    async def _answered(self, frame: StreamFrame, fixed: FixedGrid | None, limit: asyncio.Timeout) -> StreamResult:
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
            if picture.shared is not None:
                np.copyto(picture.shared.target, picture.shared.source)
            return self._answer(frame, FrameStatus.PASSED_THROUGH, frame.data)
        try:
            data = await self._corrected(picture, fixed.fitted, limit)
        except Unavailable:
            raise
        except DeadlineExceeded as error:
            end_s = limit.when()
            late = end_s is not None and asyncio.get_running_loop().time() >= end_s
            return self._failed(frame, _too_late(frame) if late else error)
        except UnbendError as error:
            return self._failed(frame, error)
        self.meter.frame("corrected")
        return self._answer(frame, FrameStatus.CORRECTED, data)

    def _answer(self, frame: StreamFrame, status: FrameStatus, data: bytes | memoryview | Bytes) -> StreamResult:
        if frame.shared is not None:
            return StreamResult(frame.index, frame.timestamp_us, status, shared=frame.shared)
        return StreamResult(frame.index, frame.timestamp_us, status, data)

    async def _picture(self, frame: StreamFrame, fixed: FixedGrid | None) -> _Picture:
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
        await self.grid.offer(picture.frame)
        return picture

    async def _decoded(self, frame: StreamFrame) -> _Picture:
        match self.config.frame_format:
            case RawFormat(pixel_format, width, height):
                if frame.shared is None:
                    return _Picture(Frame(pixel_format, width, height, np.frombuffer(frame.data, np.uint8)))
                if frame.data:
                    raise InvalidFrame("A frame with a picture and shared memory.", allowed="one of them")
                places = frame.shared
                shared = self.regions.picture(
                    places.region_id,
                    places.source_offset,
                    places.target_offset,
                    places.size_bytes,
                    frame_size_bytes(pixel_format, width, height),
                )
                return _Picture(Frame(pixel_format, width, height, shared.source), shared=shared)
            case EncodedFormat(image_format):
                if frame.shared is not None:
                    raise InvalidFrame("A file in shared memory.", allowed="files as data, raw pictures as either")
                image = await self._decoded_file(bytes(frame.data), image_format)
                return _Picture(image.frame, image=image)

    async def _decoded_file(self, body: bytes, image_format: str) -> DecodedImage:
        bound = self.settings.body_bytes
        if len(body) > bound:
            raise BodyTooLarge(f"A frame of {len(body)} bytes.", allowed=f"{bound} bytes", setting="body_bytes")
        image = await self.turns.run(
            self.stream_id, lambda: self.blocking.run("decode", self.codec.decode, body, planes=True)
        )
        if image.image_format != image_format:
            raise InvalidFrame(f"A {image.image_format} file in a stream of {image_format} files.")
        return image

    async def _corrected(self, picture: _Picture, grid: Grid, limit: asyncio.Timeout) -> bytes | Bytes:
        frame, image = picture.frame, picture.image
        data = await self.turns.run(self.stream_id, lambda: self._drawn(picture, grid, limit))
        if image is None:
            return data
        drawn = replace(image, frame=replace(frame, data=data))
        return await self.turns.run(
            self.stream_id, lambda: self.correction.encode(drawn, drawn.image_format, self.config.options)
        )

    async def _drawn(self, picture: _Picture, grid: Grid, limit: asyncio.Timeout) -> Bytes:
        end_s = limit.when()
        left_s = None if end_s is None else end_s - asyncio.get_running_loop().time()
        # the pool keeps the time meanwhile: it knows when nobody draws in the client's memory any more
        limit.reschedule(None)
        try:
            return await self.correction.draw(
                picture.frame,
                grid,
                self.config.options.border,
                affinity=self.stream_id,
                deadline_s=left_s,
                shared=picture.shared,
            )
        finally:
            limit.reschedule(end_s)

    def _failed(self, frame: StreamFrame, error: UnbendError) -> StreamResult:
        self.meter.frame("failed")
        return StreamResult(frame.index, frame.timestamp_us, FrameStatus.FAILED, error=error)


def _too_late(frame: StreamFrame) -> DeadlineExceeded:
    return DeadlineExceeded(f"The frame was not done within the {frame.deadline_s:g} s that the client gave it.")
