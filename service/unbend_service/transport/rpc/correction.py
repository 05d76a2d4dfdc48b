"""``unbend.v1.CorrectionService``: one picture, or a stream of frames."""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import replace

import grpc

from unbend._wire import FRAME_DATA_FIELD, FRAME_FIELD, RESULT_DATA_FIELD, RESULT_FIELD, attach, detach
from unbend.v1 import correction_pb2, correction_pb2_grpc, frame_pb2
from unbend_service.application.correction import Correction
from unbend_service.application.stream_messages import (
    DrawnGuides,
    EncodedFormat,
    EstimateOver,
    GridFixed,
    GridSource,
    RawFormat,
    SharedPlaces,
    StoredGrid,
    StreamConfig,
    StreamEvent,
    StreamFrame,
)
from unbend_service.application.streams import Streams
from unbend_service.domain.errors import InvalidOption, ProtocolViolation
from unbend_service.domain.frames import PixelFormat
from unbend_service.settings import Settings
from unbend_service.transport.rpc.calls import Context, permitted
from unbend_service.transport.rpc.convert import (
    ENCODED_FORMATS,
    from_record,
    from_result,
    to_delivery,
    to_format,
    to_frame,
    to_guides,
    to_options,
    to_while_estimating,
)
from unbend_service.transport.rpc.pictures import check_body, check_pixels

Request = correction_pb2.CorrectStreamRequest
Response = correction_pb2.CorrectStreamResponse
SERVICE = correction_pb2.DESCRIPTOR.services_by_name["CorrectionService"].full_name


class CorrectionServicer(correction_pb2_grpc.CorrectionServiceServicer):
    """Straightens raw and encoded pictures, and streams of them."""

    def __init__(self, correction: Correction, streams: Streams, settings: Settings) -> None:
        self._correction = correction
        self._streams = streams
        self._settings = settings

    async def Correct(  # noqa: N802 the name of the generated base class
        self, request: correction_pb2.CorrectRequest, context: Context
    ) -> correction_pb2.CorrectResponse:
        layout = to_format(request.format.pixel_format)
        min_confidence = request.min_confidence if request.HasField("min_confidence") else None
        options = to_options(request.correct, request.rendering, min_confidence)
        options = replace(options, grid_id=request.grid_id or None, camera=request.camera or None)
        if isinstance(layout, PixelFormat):
            if request.answer_format not in (frame_pb2.PIXEL_FORMAT_UNSPECIFIED, request.format.pixel_format):
                raise InvalidOption("A raw picture comes back in its own format.", allowed="no answer_format")
            check_pixels(request.format.width, request.format.height, self._settings.source_pixels)
            frame = to_frame(layout, request.format.width, request.format.height, request.data)
            corrected = await self._correction.of_frame(frame, options)
            return correction_pb2.CorrectResponse(
                format=request.format,
                data=corrected.frame.data.tobytes(),
                record=from_record(corrected.record, whole=False),
            )
        answer_format = request.answer_format or request.format.pixel_format
        if answer_format not in ENCODED_FORMATS:
            raise InvalidOption(
                "A file comes back as a file.", allowed=f"an answer_format of {', '.join(ENCODED_FORMATS.values())}"
            )
        body = check_body(request.data, self._settings.body_bytes)
        image = await self._correction.of_image(body, replace(options, image_format=ENCODED_FORMATS[answer_format]))
        return correction_pb2.CorrectResponse(
            format=frame_pb2.FrameFormat(pixel_format=answer_format),
            data=image.body,
            record=from_record(image.record, whole=False),
        )

    async def CorrectStream(  # type: ignore[override] # noqa: N802 writes instead of yielding: a write can be ended
        self, requests: AsyncIterator[Request | StreamFrame], context: Context
    ) -> None:
        config = await self._opening(requests)
        async with self._streams.open(config) as session:
            opened = correction_pb2.StreamOpened(
                stream_id=session.stream_id, resumed=session.resumed, max_in_flight=session.max_in_flight
            )
            await context.write(Response(opened=opened))
            async for event in session.run(_frames(requests)):
                await context.write(event)

    async def _opening(self, requests: AsyncIterator[Request | StreamFrame]) -> StreamConfig:
        async for request in requests:
            if isinstance(request, StreamFrame) or request.WhichOneof("message") != "open":
                break
            return to_config(request.open)
        raise ProtocolViolation("A stream begins with its open message.", allowed="open, then frames")


def to_config(message: correction_pb2.StreamOpen) -> StreamConfig:
    """How a stream is to be treated. Raises InvalidOption, InvalidGuides, UnsupportedPixelFormat."""
    layout = to_format(message.format.pixel_format)
    min_confidence = message.min_confidence if message.HasField("min_confidence") else None
    return StreamConfig(
        frame_format=RawFormat(layout, message.format.width, message.format.height)
        if isinstance(layout, PixelFormat)
        else EncodedFormat(layout),
        stream_id=message.stream_id,
        options=to_options(message.correct, message.rendering, min_confidence),
        grid_source=_grid_source(message),
        while_estimating=to_while_estimating(message.while_estimating),
        delivery=to_delivery(message.delivery),
        estimate_again=message.estimate_again,
    )


def _grid_source(message: correction_pb2.StreamOpen) -> GridSource:
    match message.WhichOneof("grid_source"):
        case "grid_id":
            return StoredGrid(message.grid_id)
        case "guides":
            return DrawnGuides(to_guides(message.guides))
        case _:
            return EstimateOver(message.estimate.frames or None)


async def _frames(requests: AsyncIterator[Request | StreamFrame]) -> AsyncIterator[StreamFrame]:
    async for request in requests:
        if not isinstance(request, StreamFrame):
            raise ProtocolViolation("A stream is opened once.", allowed="open, then frames")
        await permitted().caller.frame()
        yield request


def read_request(body: bytes) -> Request | StreamFrame:
    """A message of a stream; the picture of a frame is shown where it lies in ``body``."""
    if (parts := detach(body, FRAME_FIELD, FRAME_DATA_FIELD)) is not None:
        return _to_stream_frame(correction_pb2.StreamFrame.FromString(parts[0]), parts[1])
    request = Request.FromString(body)
    if request.WhichOneof("message") == "frame":
        return _to_stream_frame(request.frame, request.frame.data)
    return request


def _to_stream_frame(message: correction_pb2.StreamFrame, data: bytes | memoryview) -> StreamFrame:
    shared = message.shared
    places = (
        SharedPlaces(shared.region_id, shared.source_offset, shared.target_offset, shared.size_bytes)
        if message.HasField("shared")
        else None
    )
    deadline_s = message.deadline_ms / 1000 if message.deadline_ms else None
    return StreamFrame(message.index, message.timestamp_us, data, places, deadline_s)


def write_response(event: Response | StreamEvent) -> bytes:
    """A message of a stream; the picture of a result is copied once."""
    if isinstance(event, Response):
        return event.SerializeToString()
    if isinstance(event, GridFixed):
        grid = correction_pb2.StreamGrid(record=from_record(event.record, whole=False))
        return Response(grid=grid).SerializeToString()
    return attach(RESULT_FIELD, from_result(event).SerializeToString(), RESULT_DATA_FIELD, event.data)


def add_to_server(servicer: CorrectionServicer, server: grpc.aio.Server) -> None:
    """As the generated function does, but the pictures of streams do not go through protobuf, which copies them."""
    handlers = {
        "Correct": grpc.unary_unary_rpc_method_handler(
            servicer.Correct,
            request_deserializer=correction_pb2.CorrectRequest.FromString,
            response_serializer=correction_pb2.CorrectResponse.SerializeToString,
        ),
        "CorrectStream": grpc.stream_stream_rpc_method_handler(
            servicer.CorrectStream, request_deserializer=read_request, response_serializer=write_response
        ),
    }
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(SERVICE, handlers),))
