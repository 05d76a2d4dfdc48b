from __future__ import annotations

import grpc
import pytest

from unbend.v1 import correction_pb2, frame_pb2, grid_pb2
from unbend_service.domain.errors import BodyTooLarge, ProtocolViolation
from unbend_service.transport.rpc.messages import parse

from .conftest import Rpc

PUT = "/unbend.v1.GridService/PutGrid"
CORRECT = "/unbend.v1.CorrectionService/Correct"
STREAM = "/unbend.v1.CorrectionService/CorrectStream"


async def raw_call(rpc: Rpc, method: str, raw: bytes) -> grpc.aio.AioRpcError:
    with pytest.raises(grpc.aio.AioRpcError) as caught:
        await rpc.channel.unary_unary(method, lambda body: body, lambda body: body)(raw)
    return caught.value


@pytest.mark.parametrize(
    "method",
    [
        PUT,
        CORRECT,
        "/unbend.v1.EstimationService/Estimate",
        "/unbend.v1.GridService/GetGrid",
        "/grpc.health.v1.Health/Check",
    ],
)
async def test_garbage_is_the_callers_mistake(rpc: Rpc, method: str) -> None:
    """A message that cannot be parsed is no failure of the server."""
    error = await raw_call(rpc, method, b"\xff\xff\xff\xff garbage")
    assert error.code() is grpc.StatusCode.INVALID_ARGUMENT


@pytest.mark.parametrize(
    "method", [STREAM, "/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo", "/grpc.health.v1.Health/Watch"]
)
async def test_garbage_in_a_stream_is_the_callers_mistake(rpc: Rpc, method: str) -> None:
    """In streams too, and in those of health and reflection."""
    with pytest.raises(grpc.aio.AioRpcError) as caught:
        async for _ in rpc.channel.stream_stream(method, lambda body: body, lambda body: body)(iter([b"\xff\xff"])):
            pass
    assert caught.value.code() is grpc.StatusCode.INVALID_ARGUMENT


async def test_health_and_reflection_still_answer(rpc: Rpc) -> None:
    """What is parsed by us is understood as before."""
    check = rpc.channel.unary_unary("/grpc.health.v1.Health/Check", lambda body: body, lambda body: body)
    assert await check(b"") == b"\x08\x01"
    reflect = rpc.channel.stream_stream(
        "/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo", lambda body: body, lambda body: body
    )
    answers = [answer async for answer in reflect(iter([b"\x3a\x00"]))]
    assert b"unbend.v1.GridService" in answers[0]


def test_a_message_that_would_grow_is_refused() -> None:
    """A guide without content takes two bytes on the wire and dozens in memory."""
    guides = b"\x0a\x00" * 100_000
    message = b"\x12" + bytes([0xC0, 0x9A, 0x0C]) + guides
    assert len(grid_pb2.PutGridRequest.FromString(message).guides.rows) == 100_000
    with pytest.raises(BodyTooLarge):
        parse(PUT, grid_pb2.PutGridRequest.FromString, message)


def test_what_stands_beside_a_picture_is_bounded_and_the_picture_is_not() -> None:
    """A frame of megabytes is read; as much in a field of text is refused."""
    frame = correction_pb2.CorrectStreamRequest(frame=correction_pb2.StreamFrame(index=1, data=bytes(5 << 20)))
    assert parse(STREAM, correction_pb2.CorrectStreamRequest.FromString, frame.SerializeToString()) == frame
    large = correction_pb2.CorrectRequest(
        format=frame_pb2.FrameFormat(pixel_format=frame_pb2.PIXEL_FORMAT_JPEG), data=bytes(5 << 20), grid_id="x" * 100
    )
    assert parse(CORRECT, correction_pb2.CorrectRequest.FromString, large.SerializeToString()) == large
    large.grid_id = "x" * 100_000
    with pytest.raises(BodyTooLarge):
        parse(CORRECT, correction_pb2.CorrectRequest.FromString, large.SerializeToString())


def test_the_largest_grid_is_read() -> None:
    """1025 x 1025 points."""
    grid = grid_pb2.PutGridRequest(grid=grid_pb2.Grid(rows=1025, columns=1025, source=[0.5] * (2 * 1025 * 1025)))
    assert parse(PUT, grid_pb2.PutGridRequest.FromString, grid.SerializeToString()) == grid


@pytest.mark.parametrize("tail", [b"\x80" * 70_000, b"\x12\xff\xff\xff\xff\x7f" + bytes(70_000), b"\x08\x01" * 40_000])
def test_broken_large_messages_are_refused_without_much_ado(tail: bytes) -> None:
    """Lengths beyond the end, endless numbers and thousands of fields."""
    with pytest.raises((BodyTooLarge, ProtocolViolation)):
        parse(CORRECT, correction_pb2.CorrectRequest.FromString, tail)
