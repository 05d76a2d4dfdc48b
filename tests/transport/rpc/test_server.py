"""A real server on a free port, over fakes of the estimator and the pool."""

from __future__ import annotations

import asyncio
import struct
import zlib
from collections.abc import AsyncIterator

import cv2
import grpc
import numpy as np
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc

from tests.transport.rpc.conftest import Rpc
from unbend.v1 import correction_pb2, estimation_pb2, frame_pb2, grid_pb2
from unbend_service.domain.errors import RendererUnavailable
from unbend_service.settings import Settings
from unbend_service.transport.rpc.server import start_server

Request = correction_pb2.CorrectStreamRequest
Response = correction_pb2.CorrectStreamResponse

WIDTH, HEIGHT = 64, 48
RGB = frame_pb2.FrameFormat(pixel_format=frame_pb2.PIXEL_FORMAT_RGB24, width=WIDTH, height=HEIGHT)
JPEG = frame_pb2.FrameFormat(pixel_format=frame_pb2.PIXEL_FORMAT_JPEG)


def picture() -> np.ndarray:
    blocks = np.random.default_rng(1).integers(0, 255, (6, 8, 3), dtype=np.uint8)
    return cv2.resize(blocks, (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST)


def jpeg() -> bytes:
    return cv2.imencode(".jpg", picture())[1].tobytes()


def png_header(width: int, height: int) -> bytes:
    """The first chunks of a PNG that announces a size and has no pixels."""
    chunk = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    data = b"IDAT" + zlib.compress(b"\0" * 10)
    chunks = [chunk, data, b"IEND"]
    body = b"".join(struct.pack(">I", len(c) - 4) + c + struct.pack(">I", zlib.crc32(c)) for c in chunks)
    return b"\x89PNG\r\n\x1a\n" + body


def code_of(error: grpc.aio.AioRpcError) -> str:
    return str(dict(error.trailing_metadata() or ()).get("unbend-error-code"))


async def still_serves(rpc: Rpc) -> None:
    answer = await rpc.correction.Correct(correction_pb2.CorrectRequest(format=RGB, data=picture().tobytes()))
    assert len(answer.data) == WIDTH * HEIGHT * 3


async def test_a_raw_picture_is_corrected(rpc: Rpc) -> None:
    request = correction_pb2.CorrectRequest(format=RGB, data=picture().tobytes())

    answer = await rpc.correction.Correct(request)

    assert answer.format == RGB
    assert len(answer.data) == WIDTH * HEIGHT * 3
    assert answer.data != request.data
    assert answer.record.outcome == grid_pb2.OUTCOME_CORRECTED
    assert not answer.record.HasField("grid")


async def test_a_file_comes_back_as_a_file_of_the_same_or_the_asked_format(rpc: Rpc) -> None:
    same = await rpc.correction.Correct(correction_pb2.CorrectRequest(format=JPEG, data=jpeg()))
    other = await rpc.correction.Correct(
        correction_pb2.CorrectRequest(format=JPEG, data=jpeg(), answer_format=frame_pb2.PIXEL_FORMAT_PNG)
    )

    assert same.data.startswith(b"\xff\xd8")
    assert other.data.startswith(b"\x89PNG")
    assert other.format.pixel_format == frame_pb2.PIXEL_FORMAT_PNG


async def test_an_estimate_is_stored_and_can_correct(rpc: Rpc) -> None:
    request = estimation_pb2.EstimateRequest(format=RGB, data=picture().tobytes())
    record = (await rpc.estimation.Estimate(request)).record
    from_file = (await rpc.estimation.Estimate(estimation_pb2.EstimateRequest(format=JPEG, data=jpeg()))).record

    stored = (await rpc.grids.GetGrid(grid_pb2.GetGridRequest(grid_id=record.grid_id))).record
    answer = await rpc.correction.Correct(
        correction_pb2.CorrectRequest(format=RGB, data=picture().tobytes(), grid_id=record.grid_id)
    )

    assert from_file.grid_id == record.grid_id
    assert stored == record
    assert len(record.grid.source) == 2 * 17 * 17
    assert len(record.guides.rows) == 4
    assert answer.record.grid_id == record.grid_id
    assert rpc.meter.estimates.total() == 2


async def test_grids_and_guides_are_kept_and_forgotten(rpc: Rpc) -> None:
    record = (await rpc.estimation.Estimate(estimation_pb2.EstimateRequest(format=JPEG, data=jpeg()))).record

    from_guides = (await rpc.grids.PutGrid(grid_pb2.PutGridRequest(guides=record.guides))).record
    from_grid = (await rpc.grids.PutGrid(grid_pb2.PutGridRequest(grid=from_guides.grid))).record
    await rpc.grids.DeleteGrid(grid_pb2.DeleteGridRequest(grid_id=from_grid.grid_id))

    assert from_grid.grid_id == from_guides.grid_id
    with pytest.raises(grpc.aio.AioRpcError) as gone:
        await rpc.grids.GetGrid(grid_pb2.GetGridRequest(grid_id=from_grid.grid_id))
    assert gone.value.code() is grpc.StatusCode.NOT_FOUND


FOLDED = [0.9 if (i // 2) % 3 == 0 else -0.9 if (i // 2) % 3 == 2 else 0.0 for i in range(18)]


@pytest.mark.parametrize(
    ("request_", "code", "status"),
    [
        (correction_pb2.CorrectRequest(format=JPEG), "empty_body", grpc.StatusCode.INVALID_ARGUMENT),
        (
            correction_pb2.CorrectRequest(format=JPEG, data=b"text, not an image"),
            "unsupported_media_type",
            grpc.StatusCode.INVALID_ARGUMENT,
        ),
        (
            correction_pb2.CorrectRequest(format=JPEG, data=jpeg()[:200]),
            "invalid_image",
            grpc.StatusCode.INVALID_ARGUMENT,
        ),
        (
            correction_pb2.CorrectRequest(format=JPEG, data=png_header(30_000, 30_000)),
            "too_many_pixels",
            grpc.StatusCode.INVALID_ARGUMENT,
        ),
        (
            correction_pb2.CorrectRequest(format=JPEG, data=bytes(2 << 20)),
            "body_too_large",
            grpc.StatusCode.INVALID_ARGUMENT,
        ),
        (correction_pb2.CorrectRequest(data=b"x"), "unsupported_pixel_format", grpc.StatusCode.INVALID_ARGUMENT),
        (
            correction_pb2.CorrectRequest(format=frame_pb2.FrameFormat(pixel_format=99), data=b"x"),  # type: ignore[arg-type] # on purpose
            "unsupported_pixel_format",
            grpc.StatusCode.INVALID_ARGUMENT,
        ),
        (correction_pb2.CorrectRequest(format=RGB, data=b"x"), "invalid_frame", grpc.StatusCode.INVALID_ARGUMENT),
        (
            correction_pb2.CorrectRequest(
                format=frame_pb2.FrameFormat(
                    pixel_format=frame_pb2.PIXEL_FORMAT_GRAY8, width=2**32 - 1, height=2**32 - 1
                )
            ),
            "too_many_pixels",
            grpc.StatusCode.INVALID_ARGUMENT,
        ),
        (
            correction_pb2.CorrectRequest(format=RGB, data=picture().tobytes(), grid_id="gnone"),
            "grid_not_found",
            grpc.StatusCode.NOT_FOUND,
        ),
        (
            correction_pb2.CorrectRequest(
                format=RGB, data=picture().tobytes(), rendering=frame_pb2.Rendering(strength=float("nan"))
            ),
            "invalid_option",
            grpc.StatusCode.INVALID_ARGUMENT,
        ),
        (
            correction_pb2.CorrectRequest(
                format=RGB, data=picture().tobytes(), answer_format=frame_pb2.PIXEL_FORMAT_JPEG
            ),
            "invalid_option",
            grpc.StatusCode.INVALID_ARGUMENT,
        ),
        (
            correction_pb2.CorrectRequest(format=JPEG, data=jpeg(), answer_format=frame_pb2.PIXEL_FORMAT_I420),
            "invalid_option",
            grpc.StatusCode.INVALID_ARGUMENT,
        ),
        (estimation_pb2.EstimateRequest(format=JPEG), "empty_body", grpc.StatusCode.INVALID_ARGUMENT),
        (estimation_pb2.EstimateRequest(format=RGB, data=b"12"), "invalid_frame", grpc.StatusCode.INVALID_ARGUMENT),
        (grid_pb2.GetGridRequest(grid_id="gnone"), "grid_not_found", grpc.StatusCode.NOT_FOUND),
        (grid_pb2.DeleteGridRequest(grid_id="gnone"), "grid_not_found", grpc.StatusCode.NOT_FOUND),
        (grid_pb2.PutGridRequest(), "invalid_grid", grpc.StatusCode.INVALID_ARGUMENT),
        (
            grid_pb2.PutGridRequest(grid=grid_pb2.Grid(rows=2, columns=2, source=[float("nan")] * 8)),
            "invalid_grid",
            grpc.StatusCode.INVALID_ARGUMENT,
        ),
        (
            grid_pb2.PutGridRequest(grid=grid_pb2.Grid(rows=3, columns=3, source=FOLDED)),
            "folded_grid",
            grpc.StatusCode.INVALID_ARGUMENT,
        ),
    ],
)
async def test_bad_input_is_a_typed_error_and_the_server_still_serves(
    rpc: Rpc, request_: object, code: str, status: grpc.StatusCode
) -> None:
    method = {
        correction_pb2.CorrectRequest: rpc.correction.Correct,
        estimation_pb2.EstimateRequest: rpc.estimation.Estimate,
        grid_pb2.GetGridRequest: rpc.grids.GetGrid,
        grid_pb2.PutGridRequest: rpc.grids.PutGrid,
        grid_pb2.DeleteGridRequest: rpc.grids.DeleteGrid,
    }[type(request_)]

    with pytest.raises(grpc.aio.AioRpcError) as refused:
        await method(request_)

    assert (code_of(refused.value), refused.value.code()) == (code, status)
    await still_serves(rpc)


async def test_a_message_beyond_the_bound_is_refused_by_the_transport(rpc: Rpc) -> None:
    with pytest.raises(grpc.aio.AioRpcError) as refused:
        await rpc.correction.Correct(correction_pb2.CorrectRequest(format=JPEG, data=bytes((160 << 20) + 1)))

    assert refused.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
    await still_serves(rpc)


async def test_an_error_of_the_program_says_nothing_of_its_inside(rpc: Rpc) -> None:
    rpc.pool.failure = ZeroDivisionError("secret")  # type: ignore[assignment] # not an error of the tree, on purpose

    with pytest.raises(grpc.aio.AioRpcError) as failed:
        await still_serves(rpc)

    assert failed.value.code() is grpc.StatusCode.INTERNAL
    assert "secret" not in str(failed.value)


async def test_calls_are_counted_with_method_and_code_and_carry_their_request_id(rpc: Rpc) -> None:
    call = rpc.correction.Correct(
        correction_pb2.CorrectRequest(format=RGB, data=picture().tobytes()), metadata=(("x-request-id", "abc"),)
    )
    await call
    with pytest.raises(grpc.aio.AioRpcError):
        await rpc.grids.GetGrid(grid_pb2.GetGridRequest(grid_id="gnone"))

    assert dict(await call.trailing_metadata())["x-request-id"] == "abc"
    assert rpc.meter.requests == [
        ("grpc", "CorrectionService/Correct", "OK"),
        ("grpc", "GridService/GetGrid", "NOT_FOUND"),
    ]


def opening(**fields: object) -> Request:
    return Request(open=correction_pb2.StreamOpen(**{"format": RGB, **fields}))  # type: ignore[arg-type] # any field


def frame(index: int, data: bytes | None = None) -> Request:
    message = correction_pb2.StreamFrame(
        index=index, timestamp_us=index * 40_000, data=picture().tobytes() if data is None else data
    )
    return Request(frame=message)


async def converse(rpc: Rpc, *requests: Request) -> list[Response]:
    return [response async for response in rpc.correction.CorrectStream(iter(requests))]


def results(responses: list[Response]) -> list[correction_pb2.StreamResult]:
    return [response.result for response in responses if response.HasField("result")]


async def test_a_stream_is_opened_gets_its_grid_and_answers_in_order(rpc: Rpc) -> None:
    responses = await converse(rpc, opening(stream_id="camera-7"), *[frame(i) for i in range(20)])

    assert responses[0].opened.stream_id == "camera-7"
    assert not responses[0].opened.resumed
    assert responses[1].grid.record.grid_id.startswith("g")
    assert [(r.index, r.timestamp_us) for r in results(responses)] == [(i, i * 40_000) for i in range(20)]
    assert {r.status for r in results(responses)} == {correction_pb2.FRAME_STATUS_CORRECTED}
    assert rpc.meter.estimates == {"corrected": 1}


async def test_a_stream_is_resumed_with_the_same_grid_and_no_second_estimate(rpc: Rpc) -> None:
    before = await converse(rpc, opening(stream_id="camera-7"), *[frame(i) for i in range(6)])
    after = await converse(rpc, opening(stream_id="camera-7"), *[frame(i) for i in range(6, 9)])

    assert after[0].opened.resumed
    assert after[1].grid.record.grid_id == before[1].grid.record.grid_id
    assert rpc.meter.estimates == {"corrected": 1}


async def test_a_frame_of_the_wrong_size_fails_alone(rpc: Rpc) -> None:
    responses = await converse(rpc, opening(), frame(0), frame(1, b"short"), frame(2))

    assert [r.status for r in results(responses)] == [
        correction_pb2.FRAME_STATUS_CORRECTED,
        correction_pb2.FRAME_STATUS_FAILED,
        correction_pb2.FRAME_STATUS_CORRECTED,
    ]
    error = results(responses)[1].error
    assert error.code == "invalid_frame"
    assert "9216 bytes, not 5" in error.message


async def test_a_broken_file_in_a_stream_of_files_fails_alone(rpc: Rpc) -> None:
    bodies = [b"", b"text", jpeg()[:200], jpeg()]
    responses = await converse(rpc, opening(format=JPEG), *[frame(i, body) for i, body in enumerate(bodies)])

    assert [r.error.code for r in results(responses)] == ["empty_body", "unsupported_media_type", "invalid_image", ""]


@pytest.mark.parametrize(
    ("requests", "code"),
    [
        ([], "protocol_violation"),
        ([frame(0)], "protocol_violation"),
        ([opening(), opening()], "protocol_violation"),
        ([opening(), Request()], "protocol_violation"),
        ([opening(), frame(1), frame(1)], "protocol_violation"),
        ([opening(format=frame_pb2.FrameFormat())], "unsupported_pixel_format"),
        ([opening(format=frame_pb2.FrameFormat(pixel_format=77))], "unsupported_pixel_format"),
        ([opening(format=frame_pb2.FrameFormat(pixel_format=1))], "invalid_frame"),
        ([opening(grid_id="gnone")], "grid_not_found"),
        ([opening(guides=grid_pb2.Guides())], "invalid_guides"),
        ([opening(stream_id="no spaces")], "invalid_option"),
        ([opening(delivery=9)], "invalid_option"),
        ([opening(estimate=correction_pb2.EstimateFrames(frames=65))], "invalid_option"),
    ],
)
async def test_a_stream_that_cannot_be_ends_with_a_typed_error_and_the_server_still_serves(
    rpc: Rpc, requests: list[Request], code: str
) -> None:
    with pytest.raises(grpc.aio.AioRpcError) as refused:
        await converse(rpc, *requests)

    assert code_of(refused.value) == code
    assert rpc.service.streams.active == 0
    await still_serves(rpc)


async def unfinished() -> AsyncIterator[Request]:
    """A few frames, and then silence: grpc.aio forgets the status of a call that ends during a write (grpc#36066)."""
    yield opening(stream_id="camera-7")
    for index in range(6):
        yield frame(index)
    await asyncio.sleep(60)


async def read_to_the_end(call: grpc.aio.StreamStreamCall[Request, Response]) -> None:
    while await call.read() is not grpc.aio.EOF:
        pass


async def eventually(condition) -> None:
    for _ in range(500):
        if condition():
            return
        await asyncio.sleep(0.02)
    raise AssertionError("it did not happen")


async def test_a_client_that_cancels_leaves_nothing_behind(rpc: Rpc) -> None:
    call = rpc.correction.CorrectStream(unfinished())
    await call.read()
    assert rpc.service.streams.active == 1

    call.cancel()

    await eventually(lambda: rpc.service.streams.active == 0)
    await eventually(lambda: rpc.meter.requests[-1:] == [("grpc", "CorrectionService/CorrectStream", "CANCELLED")])
    assert rpc.service.admission.active == 0


async def test_a_second_connection_takes_a_stream_over_and_the_first_is_told(rpc: Rpc) -> None:
    older = rpc.correction.CorrectStream(unfinished())
    await older.read()

    newer = await converse(rpc, opening(stream_id="camera-7"), frame(0))

    with pytest.raises(grpc.aio.AioRpcError) as ended:
        await read_to_the_end(older)
    assert code_of(ended.value) == "stream_taken_over"
    assert ended.value.code() is grpc.StatusCode.ABORTED
    assert len(results(newer)) == 1


async def test_a_stuck_reader_can_be_taken_over(rpc: Rpc) -> None:
    """The older connection never reads, so that the server hangs in a write."""
    stuck = rpc.correction.CorrectStream()
    large = frame_pb2.FrameFormat(pixel_format=frame_pb2.PIXEL_FORMAT_GRAY8, width=4000, height=4000)
    one = correction_pb2.EstimateFrames(frames=1)
    await stuck.write(opening(stream_id="camera-7", format=large, min_confidence=1.0, estimate=one))
    for index in range(8):
        await stuck.write(frame(index, bytes(16_000_000)))
    await eventually(lambda: rpc.meter.frames["left_alone"] >= 3)

    await asyncio.wait_for(converse(rpc, opening(stream_id="camera-7"), frame(0)), 5)

    await eventually(lambda: rpc.service.streams.active == 0)
    stuck.cancel()


async def test_draining_ends_streams_after_what_was_accepted_and_refuses_new_calls(rpc: Rpc) -> None:
    call = rpc.correction.CorrectStream(unfinished())
    for _ in range(4):
        await call.read()

    assert await rpc.service.admission.drain(5.0)

    with pytest.raises(grpc.aio.AioRpcError) as ended:
        await read_to_the_end(call)
    assert (code_of(ended.value), ended.value.code()) == ("draining", grpc.StatusCode.UNAVAILABLE)
    with pytest.raises(grpc.aio.AioRpcError) as refused:
        await still_serves(rpc)
    assert code_of(refused.value) == "draining"


async def test_a_pool_that_is_gone_is_unavailable(rpc: Rpc) -> None:
    rpc.pool.failure = RendererUnavailable("No worker.")

    with pytest.raises(grpc.aio.AioRpcError) as ended:
        await converse(rpc, opening(), frame(0))

    assert ended.value.code() is grpc.StatusCode.UNAVAILABLE


async def test_health_follows_the_readiness_of_the_service(rpc: Rpc) -> None:
    health = health_pb2_grpc.HealthStub(rpc.channel)
    serving, not_serving = health_pb2.HealthCheckResponse.SERVING, health_pb2.HealthCheckResponse.NOT_SERVING
    name = "unbend.v1.CorrectionService"
    watch = health.Watch(health_pb2.HealthCheckRequest())

    assert (await watch.read()).status == serving
    assert (await health.Check(health_pb2.HealthCheckRequest(service=name))).status == serving
    rpc.pool.ready = False
    assert (await watch.read()).status == not_serving
    assert (await health.Check(health_pb2.HealthCheckRequest(service=name))).status == not_serving
    with pytest.raises(grpc.aio.AioRpcError) as unknown:
        await health.Check(health_pb2.HealthCheckRequest(service="nobody"))
    assert unknown.value.code() is grpc.StatusCode.NOT_FOUND
    watch.cancel()


async def test_a_service_that_drains_or_has_no_renderer_is_alive_and_must_not_be_restarted(rpc: Rpc) -> None:
    health = health_pb2_grpc.HealthStub(rpc.channel)
    rpc.pool.ready = False
    await rpc.service.admission.drain(0)

    assert (await health.Check(health_pb2.HealthCheckRequest())).status == health_pb2.HealthCheckResponse.NOT_SERVING
    live = await health.Check(health_pb2.HealthCheckRequest(service="live"))
    assert live.status == health_pb2.HealthCheckResponse.SERVING


async def test_reflection_lists_the_services(rpc: Rpc) -> None:
    stub = reflection_pb2_grpc.ServerReflectionStub(rpc.channel)
    call = stub.ServerReflectionInfo(iter([reflection_pb2.ServerReflectionRequest(list_services="")]))
    names = {service.name for service in (await call.read()).list_services_response.service}

    assert {"unbend.v1.CorrectionService", "unbend.v1.EstimationService", "unbend.v1.GridService"} <= names
    assert "grpc.health.v1.Health" in names


async def test_an_address_that_is_taken_is_an_os_error(rpc: Rpc) -> None:
    settings = Settings(grpc_port=0)
    server, port = await start_server(rpc.service, settings)
    with pytest.raises(OSError, match=str(port)):
        await start_server(rpc.service, Settings(grpc_port=port))
    await server.stop(0)
