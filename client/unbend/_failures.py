"""Errors of gRPC and of single frames, as errors of this package: the one table."""

from __future__ import annotations

from typing import Any
from urllib.parse import unquote

import grpc

from unbend import _errors as errors

#: For calls that end without an error code of Unbend: before they reached it, or in spite of it.
BY_STATUS: dict[grpc.StatusCode, type[errors.UnbendError]] = {
    grpc.StatusCode.CANCELLED: errors.Unreachable,  # not by us: a server that stops cancels what is left
    grpc.StatusCode.UNKNOWN: errors.ServerFault,
    grpc.StatusCode.INVALID_ARGUMENT: errors.InvalidInput,
    grpc.StatusCode.DEADLINE_EXCEEDED: errors.DeadlineExceeded,
    grpc.StatusCode.NOT_FOUND: errors.ServerFault,
    grpc.StatusCode.ALREADY_EXISTS: errors.ServerFault,
    grpc.StatusCode.PERMISSION_DENIED: errors.PermissionDenied,
    grpc.StatusCode.RESOURCE_EXHAUSTED: errors.BodyTooLarge,  # of the transport itself: the message bound
    grpc.StatusCode.FAILED_PRECONDITION: errors.ServerFault,
    grpc.StatusCode.ABORTED: errors.ServerFault,
    grpc.StatusCode.OUT_OF_RANGE: errors.ServerFault,
    grpc.StatusCode.UNIMPLEMENTED: errors.ServerFault,
    grpc.StatusCode.INTERNAL: errors.ServerFault,
    grpc.StatusCode.UNAVAILABLE: errors.Unreachable,
    grpc.StatusCode.DATA_LOSS: errors.ServerFault,
    grpc.StatusCode.UNAUTHENTICATED: errors.Unauthenticated,
}

#: What proxies make of a server that vanished in the middle of a call. The service itself answers with a request id.
_OF_PROXIES = (grpc.StatusCode.UNKNOWN, grpc.StatusCode.INTERNAL)


def translate(error: Any) -> errors.UnbendError:
    """The error of a call that failed, a ``grpc.RpcError`` that is also a ``grpc.Call``."""
    trailing = dict(error.trailing_metadata() or ())
    plain = {key: value for key, value in trailing.items() if key.startswith("unbend-error-")}
    code = plain.get("unbend-error-code")
    if code is None:
        broken = error.code() in _OF_PROXIES and "x-request-id" not in trailing
        kind = errors.Unreachable if broken else BY_STATUS[error.code()]
        return kind(error.details() or error.code().name)
    retry_after_s = plain.get("unbend-error-retry-after-s")
    translated = errors.BY_CODE.get(code, errors.UnbendError)(
        unquote(plain.get("unbend-error-message", code)),
        allowed=_unquoted(plain.get("unbend-error-allowed")),
        setting=_unquoted(plain.get("unbend-error-setting")),
        retry_after_s=None if retry_after_s is None else float(retry_after_s),
    )
    last_index = plain.get("unbend-error-last-index")
    translated.last_index = None if last_index is None else int(last_index)
    return translated


def of_frame(code: str, message: str) -> errors.UnbendError:
    """The error of one frame of a stream."""
    return errors.BY_CODE.get(code, errors.UnbendError)(message)


def _unquoted(text: str | None) -> str | None:
    return None if text is None else unquote(text)
