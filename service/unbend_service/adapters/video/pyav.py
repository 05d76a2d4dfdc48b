"""PyAV, loaded when it is first needed, and its errors as ours."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from unbend_service.domain.errors import InvalidImage, Unavailable


def load_av() -> Any:
    """The module ``av``. Raises Unavailable without the extra ``[video]``."""
    try:
        import av
    except ImportError as error:
        raise Unavailable("PyAV is not installed here.", allowed="pip install 'unbend[video]'") from error
    # PyAV's log must stay off, as it is by default: its callback takes the GIL in FFmpeg's threads, which a decoder
    # that is being freed waits for while it holds the GIL
    av.logging.set_level(None)
    return av


@contextmanager
def av_errors(what: str) -> Iterator[None]:
    """Turns FFmpeg's errors into InvalidImage, whose message starts with ``what``; errors of files stay OSError."""
    av = load_av()
    try:
        yield
    except av.error.FFmpegError as error:
        if isinstance(error, FileNotFoundError | PermissionError | IsADirectoryError):
            raise
        raise InvalidImage(f"{what}: {error.strerror or error}") from error
