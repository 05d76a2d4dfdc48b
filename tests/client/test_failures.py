"""Errors of gRPC, as errors of the client."""

from __future__ import annotations

from types import SimpleNamespace

import grpc
import pytest

import unbend
from unbend._failures import BY_STATUS, translate
from unbend._retries import Attempts
from unbend_service.domain import errors as service_errors
from unbend_service.transport.rpc.status import STATUS_CODES, status_of


def failed(code: grpc.StatusCode, message: str, metadata: object = None) -> SimpleNamespace:
    """What a call that failed looks like."""
    return SimpleNamespace(code=lambda: code, details=lambda: message, trailing_metadata=lambda: metadata)


def test_every_status_has_its_line_in_the_table() -> None:
    assert set(BY_STATUS) == set(grpc.StatusCode) - {grpc.StatusCode.OK}


@pytest.mark.parametrize("code", list(BY_STATUS))
def test_a_status_without_a_code_of_ours_has_a_type_too(code: grpc.StatusCode) -> None:
    error = translate(failed(code, "Something.", (("x-request-id", "7"),)))

    assert type(error) is BY_STATUS[code]
    assert "Something." in str(error)


@pytest.mark.parametrize("code", [grpc.StatusCode.UNKNOWN, grpc.StatusCode.INTERNAL])
def test_a_server_that_vanished_behind_a_proxy_is_unreachable(code: grpc.StatusCode) -> None:
    """Envoy resets the stream, which says as little as a fault does; but whoever vanished gave no request id."""
    error = translate(failed(code, "Stream removed (Received RST_STREAM with error code 2)"))

    assert type(error) is unbend.Unreachable


@pytest.mark.parametrize("kind", list(STATUS_CODES))
def test_an_error_survives_the_wire(kind: type[service_errors.UnbendError]) -> None:
    sent = kind("Häßlich, 100 %.", allowed="1…2", setting="streams", retry_after_s=0.25)
    status = status_of(sent)

    error = translate(failed(status.code, status.message, status.trailing_metadata))

    assert type(error).__name__ == kind.__name__
    assert str(error) == str(sent)
    assert (error.code, error.allowed, error.setting) == (sent.code, sent.allowed, sent.setting)
    assert error.retry_after_s == 0.25


def test_a_code_that_is_newer_than_the_client_is_still_an_error_of_unbend() -> None:
    metadata = (("unbend-error-code", "from_the_future"), ("unbend-error-message", "Later."))

    assert type(translate(failed(grpc.StatusCode.INTERNAL, "", metadata))) is unbend.UnbendError


def test_only_what_may_help_is_tried_again_and_only_what_may_be_repeated() -> None:
    attempts = Attempts(10, 1, repeatable=True)
    assert 0 < attempts.pause_s(unbend.Unreachable("Gone.")) <= 0.1
    with pytest.raises(unbend.Unreachable):
        attempts.pause_s(unbend.Unreachable("Gone."))
    with pytest.raises(unbend.InvalidOption):
        Attempts(10, 5, repeatable=True).pause_s(unbend.InvalidOption("Never."))
    with pytest.raises(unbend.Unreachable):
        Attempts(10, 5, repeatable=False).pause_s(unbend.Unreachable("Gone."))


def test_a_pause_longer_than_the_time_left_is_not_begun() -> None:
    with pytest.raises(unbend.DeadlineExceeded) as error:
        Attempts(1, 5, repeatable=True).pause_s(unbend.QueueFull("Full.", retry_after_s=2))
    assert isinstance(error.value.__cause__, unbend.QueueFull)
