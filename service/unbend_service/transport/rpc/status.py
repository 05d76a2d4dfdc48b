"""Errors of the application as gRPC statuses: the one table, and how the details travel."""

from __future__ import annotations

from dataclasses import dataclass
from urllib.parse import quote

import grpc
from google.protobuf import any_pb2, duration_pb2
from google.rpc import error_details_pb2, status_pb2
from grpc_status import rpc_status

from unbend_service.domain import errors

#: Reasons of google.rpc.ErrorInfo are codes of this domain, in capitals.
ERROR_DOMAIN = "unbend"

STATUS_CODES: dict[type[errors.UnbendError], grpc.StatusCode] = {
    errors.UnbendError: grpc.StatusCode.INTERNAL,
    errors.InvalidInput: grpc.StatusCode.INVALID_ARGUMENT,
    errors.EmptyBody: grpc.StatusCode.INVALID_ARGUMENT,
    errors.InvalidImage: grpc.StatusCode.INVALID_ARGUMENT,
    errors.TooManyPixels: grpc.StatusCode.INVALID_ARGUMENT,
    errors.ImageTooCostly: grpc.StatusCode.INVALID_ARGUMENT,
    errors.UnsupportedMediaType: grpc.StatusCode.INVALID_ARGUMENT,
    errors.BodyTooLarge: grpc.StatusCode.INVALID_ARGUMENT,
    errors.InvalidOption: grpc.StatusCode.INVALID_ARGUMENT,
    errors.InvalidGuides: grpc.StatusCode.INVALID_ARGUMENT,
    errors.InvalidGrid: grpc.StatusCode.INVALID_ARGUMENT,
    errors.FoldedGrid: grpc.StatusCode.INVALID_ARGUMENT,
    errors.InvalidFrame: grpc.StatusCode.INVALID_ARGUMENT,
    errors.UnsupportedPixelFormat: grpc.StatusCode.INVALID_ARGUMENT,
    errors.InvalidRegion: grpc.StatusCode.INVALID_ARGUMENT,
    errors.ProtocolViolation: grpc.StatusCode.INVALID_ARGUMENT,
    errors.GridNotFound: grpc.StatusCode.NOT_FOUND,
    errors.RegionNotFound: grpc.StatusCode.NOT_FOUND,
    errors.GridConflict: grpc.StatusCode.FAILED_PRECONDITION,
    errors.NotServedHere: grpc.StatusCode.UNIMPLEMENTED,
    errors.Refused: grpc.StatusCode.PERMISSION_DENIED,
    errors.Unauthenticated: grpc.StatusCode.UNAUTHENTICATED,
    errors.PermissionDenied: grpc.StatusCode.PERMISSION_DENIED,
    errors.Overloaded: grpc.StatusCode.RESOURCE_EXHAUSTED,
    errors.QueueFull: grpc.StatusCode.RESOURCE_EXHAUSTED,
    errors.MemoryFull: grpc.StatusCode.RESOURCE_EXHAUSTED,
    errors.TooManyRegions: grpc.StatusCode.RESOURCE_EXHAUSTED,
    errors.RateLimited: grpc.StatusCode.RESOURCE_EXHAUSTED,
    errors.TooManyStreams: grpc.StatusCode.RESOURCE_EXHAUSTED,
    errors.Unavailable: grpc.StatusCode.UNAVAILABLE,
    errors.Draining: grpc.StatusCode.UNAVAILABLE,
    errors.EstimatorUnavailable: grpc.StatusCode.UNAVAILABLE,
    errors.GridStoreUnavailable: grpc.StatusCode.UNAVAILABLE,
    errors.ModelUnavailable: grpc.StatusCode.UNAVAILABLE,
    errors.RendererUnavailable: grpc.StatusCode.UNAVAILABLE,
    errors.RenderFailed: grpc.StatusCode.INTERNAL,
    errors.PoisonFrame: grpc.StatusCode.INTERNAL,
    errors.StreamEnded: grpc.StatusCode.ABORTED,
    errors.StreamTakenOver: grpc.StatusCode.ABORTED,
    errors.StreamIdle: grpc.StatusCode.ABORTED,
    errors.RequestStalled: grpc.StatusCode.DEADLINE_EXCEEDED,
    errors.DeadlineExceeded: grpc.StatusCode.DEADLINE_EXCEEDED,
}


@dataclass(frozen=True, slots=True)
class Status:
    """How a call ends.

    Attributes:
        trailing_metadata: ``grpc-status-details-bin`` (google.rpc.Status with ErrorInfo and, where trying again helps,
            RetryInfo), and the same in plain keys for clients without google.rpc: ``unbend-error-code``,
            ``-message``, ``-allowed``, ``-setting`` (percent-encoded UTF-8) and ``-retry-after-s``; of a stream that
            ended ``-stream-id`` and, if any frame was answered, the ``-last-index`` that was.
    """

    code: grpc.StatusCode
    message: str
    trailing_metadata: tuple[tuple[str, str | bytes], ...] = ()


#: Characters that stay readable in metadata, which must be printable ASCII; all but the percent sign.
_PLAIN = " !\"#$&'()*+,-./:;<=>?@[]^_`{|}~"

INTERNAL = Status(grpc.StatusCode.INTERNAL, "The service failed; its log says why.")


def status_of(error: errors.UnbendError) -> Status:
    """The status that the table gives to an error."""
    code = next(STATUS_CODES[kind] for kind in type(error).__mro__ if kind in STATUS_CODES)
    info = error_details_pb2.ErrorInfo(reason=error.code.upper(), domain=ERROR_DOMAIN)
    plain = {"unbend-error-code": error.code, "unbend-error-message": quote(error.message, safe=_PLAIN)}
    last_index = None if error.resume is None or error.resume.last_index is None else str(error.resume.last_index)
    stream_id = None if error.resume is None else error.resume.stream_id
    for name, value in (
        ("allowed", error.allowed),
        ("setting", error.setting),
        ("stream-id", stream_id),
        ("last-index", last_index),
    ):
        if value is not None:
            info.metadata[name.replace("-", "_")] = value
            plain[f"unbend-error-{name}"] = quote(value, safe=_PLAIN)
    details = [_packed(info)]
    if error.retry_after_s is not None:
        delay = duration_pb2.Duration()
        delay.FromNanoseconds(round(error.retry_after_s * 1e9))
        details.append(_packed(error_details_pb2.RetryInfo(retry_delay=delay)))
        plain["unbend-error-retry-after-s"] = f"{error.retry_after_s:g}"
    rich = rpc_status.to_status(status_pb2.Status(code=code.value[0], message=str(error), details=details))
    return Status(code, str(error), (*rich.trailing_metadata, *plain.items()))


def _packed(message: error_details_pb2.ErrorInfo | error_details_pb2.RetryInfo) -> any_pb2.Any:
    packed = any_pb2.Any()
    packed.Pack(message)
    return packed
