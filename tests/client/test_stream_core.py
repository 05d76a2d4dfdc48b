"""What a stream sends and how it reads answers, without any wire."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import unbend
from unbend._images import FrameLayout
from unbend._stream_core import StreamCore, StreamOptions
from unbend.v1 import correction_pb2, grid_pb2

Request = correction_pb2.CorrectStreamRequest
Response = correction_pb2.CorrectStreamResponse
LAYOUT = FrameLayout.of("gray8", 2, 1)


def opened(max_in_flight: int = 8) -> Response:
    return Response(opened=correction_pb2.StreamOpened(stream_id="camera-7", max_in_flight=max_in_flight))


def frame_of(body: bytes) -> correction_pb2.StreamFrame:
    return Request.FromString(body).frame


def answer(frame: correction_pb2.StreamFrame) -> Response:
    status = correction_pb2.FRAME_STATUS_CORRECTED
    return Response(result=correction_pb2.StreamResult(index=frame.index, status=status, data=frame.data))


def started(**options: object) -> StreamCore:
    core = StreamCore(LAYOUT, StreamOptions(**options))
    core.receive(opened())
    return core


@given(st.lists(st.sampled_from(["send", "answer", "break"]), max_size=60), st.integers(1, 5))
def test_whenever_the_connection_breaks_each_frame_is_answered_once_and_in_order(
    steps: list[str], in_flight: int
) -> None:
    core = started(in_flight=in_flight, reconnects=1000)
    on_the_server: list[correction_pb2.StreamFrame] = []
    answered: list[unbend.StreamResult] = []
    sent = 0

    for step in steps:
        if step == "send" and core.has_room:
            on_the_server.append(frame_of(core.accept(np.full((1, 2), sent, np.uint8), sent)))
            sent += 1
        elif step == "answer" and on_the_server:
            result = core.receive(answer(on_the_server.pop(0)))
            assert result is not None
            answered.append(result)
        elif step == "break":
            core.lost(unbend.Unreachable("Cut."))
            first, *again = core.first()
            assert Request.FromString(first).open.stream_id == "camera-7"
            on_the_server = [frame_of(request) for request in again]
        assert len(on_the_server) <= in_flight
    for frame in on_the_server:
        result = core.receive(answer(frame))
        assert result is not None
        answered.append(result)

    assert [result.index for result in answered] == list(range(sent))
    assert [int(result.image[0, 0]) for result in answered] == list(range(sent))
    assert [result.timestamp_us for result in answered] == list(range(sent))
    assert not core.is_waiting


def test_an_answer_out_of_turn_is_a_fault_of_the_server() -> None:
    core = started()
    first, second = frame_of(core.accept(b"ab", 0)), frame_of(core.accept(b"cd", 0))

    with pytest.raises(unbend.ServerFault):
        core.receive(answer(second))
    core.receive(answer(first))
    with pytest.raises(unbend.ServerFault):
        core.receive(answer(first))


def test_the_server_may_narrow_the_window_but_not_widen_it() -> None:
    core = StreamCore(LAYOUT, StreamOptions(in_flight=4))
    for allowed, window in ((8, 4), (2, 2), (0, 2)):
        core.receive(opened(allowed))
        room = StreamCore.has_room.fget(core)
        assert room
        assert core._window == window


def test_a_new_estimate_that_was_made_is_not_asked_for_again_after_a_break() -> None:
    core = started(estimate_again=True)
    assert Request.FromString(core.first()[0]).open.estimate_again

    record = grid_pb2.GridRecord(grid_id="g1", outcome=grid_pb2.OUTCOME_CORRECTED)
    core.receive(Response(grid=correction_pb2.StreamGrid(record=record)))

    assert not Request.FromString(core.first()[0]).open.estimate_again


def test_attempts_are_counted_anew_after_each_answer() -> None:
    core = started(reconnects=1)
    for _ in range(3):
        frame = frame_of(core.accept(b"ab", 0))
        core.lost(unbend.Unreachable("Cut."))
        core.receive(answer(frame))
    core.lost(unbend.Unreachable("Cut."))
    with pytest.raises(unbend.Unreachable):
        core.lost(unbend.Unreachable("Cut."))


def test_the_pause_before_the_next_attempt_is_at_least_what_the_server_asks_for() -> None:
    core = started()

    assert core.lost(unbend.TooManyStreams("Full.", retry_after_s=3.0)) == 3.0


@pytest.mark.parametrize("error", [unbend.StreamTakenOver, unbend.InvalidOption, unbend.ServerFault, unbend.Refused])
def test_what_another_connection_would_not_mend_is_raised_at_once(error: type[unbend.UnbendError]) -> None:
    with pytest.raises(error):
        started().lost(error("No."))
