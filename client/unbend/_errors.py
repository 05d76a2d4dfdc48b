"""Every error that the client raises on purpose.

The tree; what stands in brackets is the builtin that the error also is::

    UnbendError
    ├── InvalidInput [ValueError]
    │   ├── EmptyBody
    │   ├── InvalidImage
    │   ├── TooManyPixels
    │   ├── ImageTooCostly
    │   ├── UnsupportedMediaType
    │   ├── BodyTooLarge
    │   ├── InvalidOption
    │   ├── InvalidGuides
    │   ├── InvalidGrid
    │   │   └── FoldedGrid
    │   ├── InvalidFrame
    │   ├── UnsupportedPixelFormat
    │   ├── InvalidRegion
    │   └── ProtocolViolation
    ├── GridNotFound [LookupError]
    ├── RegionNotFound [LookupError]
    ├── GridConflict
    ├── NotServedHere
    ├── Overloaded
    │   ├── QueueFull
    │   ├── MemoryFull
    │   ├── TooManyRegions
    │   ├── RateLimited
    │   └── TooManyStreams
    ├── Unavailable [ConnectionError]
    │   ├── Draining
    │   ├── EstimatorUnavailable
    │   ├── GridStoreUnavailable
    │   ├── ModelUnavailable
    │   ├── RendererUnavailable
    │   └── Unreachable            no answer from the server, or the connection broke
    ├── RenderFailed
    │   └── PoisonFrame
    ├── StreamEnded
    │   ├── StreamTakenOver
    │   └── StreamIdle
    ├── RequestStalled [TimeoutError]
    ├── DeadlineExceeded [TimeoutError]
    ├── Refused [PermissionError]
    │   ├── Unauthenticated        the server wants a token, or another
    │   └── PermissionDenied       the token is not for this
    ├── ServerFault                the server failed, or does not speak unbend.v1
    ├── Closed                     the client or stream was closed before
    └── MissingPackage [ImportError]  an optional package is not installed here
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar


class UnbendError(Exception):
    """Root of the tree.

    Attributes:
        code: stable name of the kind of error, as on the wire.
        message: what was wrong, in one sentence.
        allowed: what would have been accepted, if that can be said.
        setting: name of the server's setting that governs the limit, if one does.
        retry_after_s: seconds after which trying again makes sense, if it does.
        last_index: of a stream that ended: the last frame that was answered, None if none was.
    """

    code: ClassVar[str] = "internal"
    last_index: int | None = None

    def __init__(
        self,
        message: str,
        *,
        allowed: str | None = None,
        setting: str | None = None,
        retry_after_s: float | None = None,
    ) -> None:
        super().__init__(message)
        self.message = message
        self.allowed = allowed
        self.setting = setting
        self.retry_after_s = retry_after_s

    def __str__(self) -> str:
        parts = [self.message]
        if self.allowed:
            parts.append(f"Allowed: {self.allowed}.")
        if self.setting:
            parts.append(f"Setting: {self.setting}.")
        return " ".join(parts)


class InvalidInput(UnbendError, ValueError):
    """Something that can never be accepted as it is."""

    code = "invalid_input"


class EmptyBody(InvalidInput):
    """Nothing was sent where an image was expected."""

    code = "empty_body"


class InvalidImage(InvalidInput):
    """The bytes have a known signature but cannot be decoded."""

    code = "invalid_image"


class TooManyPixels(InvalidInput):
    """More pixels than the server accepts."""

    code = "too_many_pixels"


class ImageTooCostly(InvalidInput):
    """Decoding the image takes more memory or time than the server grants."""

    code = "image_too_costly"


class UnsupportedMediaType(InvalidInput):
    """The bytes are not of an image format that is accepted."""

    code = "unsupported_media_type"


class BodyTooLarge(InvalidInput):
    """More bytes than the server accepts."""

    code = "body_too_large"


class InvalidOption(InvalidInput):
    """A parameter is out of range or unknown."""

    code = "invalid_option"


class InvalidGuides(InvalidInput):
    """Guides of the wrong shape, not finite, or that do not intersect."""

    code = "invalid_guides"


class InvalidGrid(InvalidInput):
    """A lattice of the wrong shape, not finite, or out of range."""

    code = "invalid_grid"


class FoldedGrid(InvalidGrid):
    """The map turns over itself."""

    code = "folded_grid"


class InvalidFrame(InvalidInput):
    """An array or frame whose type, shape or size does not fit its pixel format or stream."""

    code = "invalid_frame"


class UnsupportedPixelFormat(InvalidInput):
    """A pixel format that is not known."""

    code = "unsupported_pixel_format"


class InvalidRegion(InvalidInput):
    """Memory that the server cannot share, or a part that does not lie inside of it."""

    code = "invalid_region"


class ProtocolViolation(InvalidInput):
    """Messages of a stream in the wrong order."""

    code = "protocol_violation"


class GridNotFound(UnbendError, LookupError):
    """No grid is stored under that id."""

    code = "grid_not_found"


class RegionNotFound(UnbendError, LookupError):
    """The server knows no such memory (any more)."""

    code = "region_not_found"


class GridConflict(UnbendError):
    """The id is not the id of the content that was sent."""

    code = "grid_conflict"


class NotServedHere(UnbendError):
    """The role of this server leaves this kind of work to others."""

    code = "not_served_here"


class Overloaded(UnbendError):
    """The server is at one of its limits; trying later may help."""

    code = "overloaded"


class QueueFull(Overloaded):
    """More work waits on the server than is allowed."""

    code = "queue_full"


class MemoryFull(Overloaded):
    """The requests under way fill the memory that the server grants to all of them together."""

    code = "memory_full"


class TooManyRegions(Overloaded):
    """More memory is shared with the server than it allows."""

    code = "too_many_regions"


class RateLimited(Overloaded):
    """More calls than this token may make."""

    code = "rate_limited"


class TooManyStreams(Overloaded):
    """More streams are open than are allowed."""

    code = "too_many_streams"


class Unavailable(UnbendError, ConnectionError):
    """The server cannot work now."""

    code = "unavailable"


class Draining(Unavailable):
    """The server is shutting down and accepts nothing new."""

    code = "draining"


class EstimatorUnavailable(Unavailable):
    """The estimation node that a render node asks does not answer."""

    code = "estimator_unavailable"


class GridStoreUnavailable(Unavailable):
    """The server's grid store cannot be read or written now."""

    code = "grid_store_unavailable"


class ModelUnavailable(Unavailable):
    """The server's estimator cannot be used."""

    code = "model_unavailable"


class RendererUnavailable(Unavailable):
    """The server has no render worker, or not the renderer that it requires."""

    code = "renderer_unavailable"


class Unreachable(Unavailable):
    """The server did not answer, or the connection to it broke."""

    code = "unreachable"


class RenderFailed(UnbendError):
    """A frame could not be rendered."""

    code = "render_failed"


class PoisonFrame(RenderFailed):
    """A frame in whose rendering more than one worker died."""

    code = "poison_frame"


class StreamEnded(UnbendError):
    """The server ended a stream that was not finished."""

    code = "stream_ended"


class StreamTakenOver(StreamEnded):
    """The stream was opened again elsewhere with the same id; the newer connection has it."""

    code = "stream_taken_over"


class StreamIdle(StreamEnded):
    """No frame was sent and no answer taken for longer than the server allows."""

    code = "stream_idle"


class RequestStalled(UnbendError, TimeoutError):
    """What was sent came too slowly, or stopped."""

    code = "request_stalled"


class DeadlineExceeded(UnbendError, TimeoutError):
    """No answer within the time allowed for it."""

    code = "deadline_exceeded"


class Refused(UnbendError, PermissionError):
    """The server wants credentials, or others."""

    code = "refused"


class Unauthenticated(Refused):
    """The server wants a token, or another one than was sent."""

    code = "unauthenticated"


class PermissionDenied(Refused):
    """The token is known to the server, but not for this."""

    code = "permission_denied"


class ServerFault(UnbendError):
    """The server failed, or does not speak ``unbend.v1``."""

    code = "server_fault"


class Closed(UnbendError):
    """The client or stream was closed before."""

    code = "closed"


class MissingPackage(UnbendError, ImportError):
    """Something was asked for that needs a package which is not installed here; ``allowed`` says how to get it."""

    code = "missing_package"

    def __str__(self) -> str:
        return f"{self.message} Remedy: {self.allowed}"


def _family(kind: type[UnbendError]) -> Iterator[type[UnbendError]]:
    yield kind
    for child in kind.__subclasses__():
        yield from _family(child)


#: Every class of the tree by its code.
BY_CODE: dict[str, type[UnbendError]] = {kind.code: kind for kind in _family(UnbendError)}
