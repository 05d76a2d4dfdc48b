"""Errors of the application on the wire."""

from __future__ import annotations

from collections.abc import Iterator

import grpc
import pytest
from google.rpc import code_pb2, error_details_pb2, status_pb2

from unbend_service.domain.errors import InvalidOption, QueueFull, TooManyPixels, UnbendError
from unbend_service.transport.rpc.status import STATUS_CODES, status_of


def family(kind: type[UnbendError]) -> Iterator[type[UnbendError]]:
    yield kind
    for child in kind.__subclasses__():
        if child.__module__.startswith("unbend_service."):
            yield from family(child)


def details(metadata: tuple[tuple[str, str | bytes], ...]) -> status_pb2.Status:
    packed = dict(metadata)["grpc-status-details-bin"]
    assert isinstance(packed, bytes)
    return status_pb2.Status.FromString(packed)


def test_every_error_has_its_line_in_the_table() -> None:
    assert set(STATUS_CODES) == set(family(UnbendError))


@pytest.mark.parametrize("kind", list(family(UnbendError)))
def test_every_error_says_its_code_in_both_forms(kind: type[UnbendError]) -> None:
    status = status_of(kind("It went wrong."))
    rich = details(status.trailing_metadata)
    info = error_details_pb2.ErrorInfo()
    assert rich.details[0].Unpack(info)

    assert (info.reason, info.domain) == (kind.code.upper(), "unbend")
    assert dict(status.trailing_metadata)["unbend-error-code"] == kind.code
    assert code_pb2.Code.Name(rich.code) == status.code.name
    assert status.code is not grpc.StatusCode.OK


def test_what_is_allowed_and_which_setting_governs_it_travel_along() -> None:
    status = status_of(TooManyPixels("Too many.", allowed="at most 50 % of ½", setting="source_pixels"))
    info = error_details_pb2.ErrorInfo()
    details(status.trailing_metadata).details[0].Unpack(info)

    assert dict(info.metadata) == {"allowed": "at most 50 % of ½", "setting": "source_pixels"}
    plain = dict(status.trailing_metadata)
    assert plain["unbend-error-allowed"] == "at most 50 %25 of %C2%BD"
    assert plain["unbend-error-setting"] == "source_pixels"


def test_when_to_try_again_travels_along() -> None:
    status = status_of(QueueFull("Full.", retry_after_s=1.5))
    retry = error_details_pb2.RetryInfo()
    details(status.trailing_metadata).details[1].Unpack(retry)

    assert retry.retry_delay.ToTimedelta().total_seconds() == 1.5
    assert dict(status.trailing_metadata)["unbend-error-retry-after-s"] == "1.5"


def test_an_error_that_is_not_in_the_table_has_the_status_of_its_parent() -> None:
    class Younger(InvalidOption):
        code = "younger"

    Younger.__module__ = "tests"
    assert status_of(Younger("New.")).code is grpc.StatusCode.INVALID_ARGUMENT
