"""Messages written and read without protobuf are those that protobuf writes and reads."""

from __future__ import annotations

import numpy as np
import pytest
from google.protobuf.message import DecodeError
from hypothesis import given
from hypothesis import strategies as st

from unbend._wire import FRAME_DATA_FIELD, FRAME_FIELD, RESULT_DATA_FIELD, RESULT_FIELD, attach, detach
from unbend.v1 import correction_pb2, memory_pb2

Request = correction_pb2.CorrectStreamRequest
Response = correction_pb2.CorrectStreamResponse

frames = st.builds(
    correction_pb2.StreamFrame,
    index=st.integers(0, 2**64 - 1),
    timestamp_us=st.integers(-(2**63), 2**63 - 1),
    data=st.binary(max_size=300),
    shared=st.none() | st.builds(memory_pb2.SharedPicture, region_id=st.text(), size_bytes=st.integers(0, 2**64 - 1)),
)
results = st.builds(
    correction_pb2.StreamResult,
    index=st.integers(0, 2**64 - 1),
    timestamp_us=st.integers(-(2**63), 2**63 - 1),
    status=st.sampled_from(correction_pb2.FrameStatus.values()),
    data=st.binary(max_size=300),
    error=st.none() | st.builds(correction_pb2.FrameError, code=st.text(), message=st.text()),
)


def without_data(message: correction_pb2.StreamFrame | correction_pb2.StreamResult) -> bytes:
    rest = type(message)()
    rest.CopyFrom(message)
    rest.ClearField("data")
    return rest.SerializeToString()


@given(frames)
def test_what_is_attached_is_the_message(frame: correction_pb2.StreamFrame) -> None:
    body = attach(FRAME_FIELD, without_data(frame), FRAME_DATA_FIELD, np.frombuffer(frame.data, np.uint8))
    assert Request.FromString(body) == Request(frame=frame)


@given(results)
def test_what_protobuf_wrote_is_detached(result: correction_pb2.StreamResult) -> None:
    body = Response(result=result).SerializeToString()
    parts = detach(body, RESULT_FIELD, RESULT_DATA_FIELD)
    assert parts is not None
    rest, data = parts
    read = correction_pb2.StreamResult.FromString(rest)
    assert bytes(data) == result.data
    assert not read.data
    read.data = result.data
    assert read == result


@given(st.binary(max_size=60) | frames.map(lambda frame: Request(frame=frame).SerializeToString()), st.data())
def test_a_broken_message_is_left_to_protobuf_or_read_as_protobuf_reads_it(body: bytes, data: st.DataObject) -> None:
    """Nothing crashes, and nothing is read that is not there."""
    cut = body[: data.draw(st.integers(0, len(body)))]
    parts = detach(cut, FRAME_FIELD, FRAME_DATA_FIELD)
    if parts is None:
        return
    try:
        frame = correction_pb2.StreamFrame.FromString(parts[0])
    except DecodeError:
        with pytest.raises(DecodeError):
            Request.FromString(cut)
        return
    frame.data = bytes(parts[1])
    assert Request.FromString(cut).frame == frame


def test_other_messages_and_unusual_ones_are_left_to_protobuf() -> None:
    opening = Request(open=correction_pb2.StreamOpen(stream_id="s")).SerializeToString()
    frame = Request(frame=correction_pb2.StreamFrame(index=1, data=b"abc")).SerializeToString()
    twice = correction_pb2.StreamFrame(data=b"abc").SerializeToString() * 2
    for body in (opening, frame + frame, b"", attach(FRAME_FIELD, twice, 99, b"")):
        assert detach(body, FRAME_FIELD, FRAME_DATA_FIELD) is None


def test_a_field_of_a_later_version_is_no_obstacle() -> None:
    frame = correction_pb2.StreamFrame(index=7).SerializeToString() + b"\xfa\x01\x02hi"
    parts = detach(attach(FRAME_FIELD, frame, FRAME_DATA_FIELD, b"pixels"), FRAME_FIELD, FRAME_DATA_FIELD)
    assert parts is not None
    assert correction_pb2.StreamFrame.FromString(parts[0]).index == 7
    assert bytes(parts[1]) == b"pixels"
