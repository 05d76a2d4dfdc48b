"""Every error that Unbend raises on purpose.

The tree (each leaf has a stable ``code``, which both transports put on the wire)::

    UnbendError
    ├── InvalidInput
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
    ├── GridNotFound
    ├── RegionNotFound
    ├── GridConflict
    ├── NotServedHere
    ├── Refused
    │   ├── Unauthenticated
    │   └── PermissionDenied
    ├── Overloaded
    │   ├── QueueFull
    │   ├── MemoryFull
    │   ├── TooManyRegions
    │   ├── RateLimited
    │   └── TooManyStreams
    ├── Unavailable
    │   ├── Draining
    │   ├── EstimatorUnavailable
    │   ├── GridStoreUnavailable
    │   ├── ModelUnavailable
    │   └── RendererUnavailable
    ├── RenderFailed
    │   └── PoisonFrame
    ├── StreamEnded
    │   ├── StreamTakenOver
    │   └── StreamIdle
    ├── RequestStalled
    └── DeadlineExceeded

The errors know neither HTTP nor gRPC: each transport owns one table from these classes to its own status codes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True, slots=True)
class Resume:
    """Where to go on with a stream that ended: after frame ``last_index``, None if none was answered."""

    stream_id: str
    last_index: int | None


class UnbendError(Exception):
    """Root of the tree.

    Args:
        message: what was wrong, in one sentence for the caller.
        allowed: what would have been accepted, if that can be said.
        setting: name of the setting that governs the limit, if one does.
        retry_after_s: seconds after which trying again makes sense, if it does.

    Attributes:
        resume: of an error that a stream ends with.
    """

    code: ClassVar[str] = "internal"
    resume: Resume | None = None

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
    """The caller sent something that can never be accepted as it is."""

    code = "invalid_input"


class EmptyBody(InvalidInput):
    """Nothing was sent where an image was expected."""

    code = "empty_body"


class InvalidImage(InvalidInput):
    """The bytes have a known signature but cannot be decoded."""

    code = "invalid_image"


class TooManyPixels(InvalidInput):
    """The image header announces more pixels than the service accepts."""

    code = "too_many_pixels"


class ImageTooCostly(InvalidInput):
    """Decoding the image takes more memory or time than the service grants."""

    code = "image_too_costly"


class UnsupportedMediaType(InvalidInput):
    """The bytes are not of an image format that is accepted."""

    code = "unsupported_media_type"


class BodyTooLarge(InvalidInput):
    """More bytes than the service accepts."""

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
    """The map turns over itself: its Jacobian changes sign over the visible part."""

    code = "folded_grid"


class InvalidFrame(InvalidInput):
    """A frame whose size does not fit what its stream or header announced."""

    code = "invalid_frame"


class UnsupportedPixelFormat(InvalidInput):
    """A pixel format that is not of the design."""

    code = "unsupported_pixel_format"


class InvalidRegion(InvalidInput):
    """Memory of a client that cannot be shared, or a part that does not lie inside of it."""

    code = "invalid_region"


class ProtocolViolation(InvalidInput):
    """Messages of a stream in the wrong order."""

    code = "protocol_violation"


class GridNotFound(UnbendError, LookupError):
    """No grid is stored under that id."""

    code = "grid_not_found"


class RegionNotFound(UnbendError, LookupError):
    """No memory is registered under that id (any more)."""

    code = "region_not_found"


class GridConflict(UnbendError):
    """The id in the request is not the id of the content that was sent."""

    code = "grid_conflict"


class NotServedHere(UnbendError):
    """The role of this service leaves this kind of work to others."""

    code = "not_served_here"


class Refused(UnbendError, PermissionError):
    """The caller is not let in."""

    code = "refused"


class Unauthenticated(Refused):
    """No token, or one that is not known (any more)."""

    code = "unauthenticated"


class PermissionDenied(Refused):
    """A token that is known, but not for this."""

    code = "permission_denied"


class Overloaded(UnbendError):
    """The service is at one of its limits; trying later may help."""

    code = "overloaded"


class QueueFull(Overloaded):
    """More work waits for a renderer than is allowed."""

    code = "queue_full"


class MemoryFull(Overloaded):
    """The requests under way fill the memory that is granted to all of them together."""

    code = "memory_full"


class TooManyRegions(Overloaded):
    """Clients share more memory than is allowed."""

    code = "too_many_regions"


class RateLimited(Overloaded):
    """More calls of one caller than it may make."""

    code = "rate_limited"


class TooManyStreams(Overloaded):
    """More streams are open than are allowed."""

    code = "too_many_streams"


class Unavailable(UnbendError):
    """The service cannot work now."""

    code = "unavailable"


class Draining(Unavailable):
    """The service is shutting down and accepts nothing new."""

    code = "draining"


class EstimatorUnavailable(Unavailable):
    """The estimation node that a render node asks does not answer."""

    code = "estimator_unavailable"


class GridStoreUnavailable(Unavailable):
    """The grid store cannot be read or written: a broken file, a full disk."""

    code = "grid_store_unavailable"


class ModelUnavailable(Unavailable):
    """The model that the setting names is not there, or its weights are not what its card says."""

    code = "model_unavailable"


class RendererUnavailable(Unavailable):
    """No render worker could be started, or the required renderer is not there."""

    code = "renderer_unavailable"


class RenderFailed(UnbendError):
    """A frame could not be rendered."""

    code = "render_failed"


class PoisonFrame(RenderFailed):
    """A frame in whose rendering more than one worker died."""

    code = "poison_frame"


class StreamEnded(UnbendError):
    """The service ended a stream that the client had not finished."""

    code = "stream_ended"


class StreamTakenOver(StreamEnded):
    """The stream was opened again elsewhere with the same id; the newer connection has it."""

    code = "stream_taken_over"


class StreamIdle(StreamEnded):
    """No frame came and no answer was taken for longer than is allowed."""

    code = "stream_idle"


class RequestStalled(UnbendError, TimeoutError):
    """The caller sends too slowly, or no more."""

    code = "request_stalled"


class DeadlineExceeded(UnbendError, TimeoutError):
    """The work was not finished within its deadline."""

    code = "deadline_exceeded"
