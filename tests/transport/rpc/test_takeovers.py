from __future__ import annotations

import asyncio
import time
from collections import Counter

import grpc

from unbend.v1 import correction_pb2, frame_pb2, grid_pb2

from .conftest import Rpc

ROWS = [grid_pb2.Guide(anchor=anchor, coefficients=[anchor, 0, 0, 0]) for anchor in (-0.5, 0.5)]
OPEN = correction_pb2.CorrectStreamRequest(
    open=correction_pb2.StreamOpen(
        stream_id="contested",
        format=frame_pb2.FrameFormat(pixel_format=frame_pb2.PIXEL_FORMAT_GRAY8, width=8, height=6),
        guides=grid_pb2.Guides(rows=ROWS, columns=ROWS),
    )
)
FRAME = correction_pb2.CorrectStreamRequest(frame=correction_pb2.StreamFrame(index=0, data=bytes(48)))


async def test_everyone_whose_stream_is_taken_over_is_told_at_once(rpc: Rpc) -> None:
    """However many open one stream at the same moment, each call ends: with its answers, or as taken over."""
    ends: Counter[grpc.StatusCode] = Counter()

    async def contend() -> None:
        for _ in range(10):
            call = rpc.correction.CorrectStream(iter([OPEN, FRAME]), timeout=20)
            try:
                async for _answer in call:
                    pass
            except grpc.aio.AioRpcError as error:
                ends[error.code()] += 1
            else:
                ends[grpc.StatusCode.OK] += 1

    started = time.monotonic()
    await asyncio.gather(*(contend() for _ in range(16)))
    assert set(ends) <= {grpc.StatusCode.OK, grpc.StatusCode.ABORTED}, ends
    assert ends[grpc.StatusCode.ABORTED]
    assert time.monotonic() - started < 20
