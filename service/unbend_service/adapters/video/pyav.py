"""PyAV, loaded when it is first needed, its errors as ours, and its pictures as frames."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from unbend_service.domain.errors import InvalidImage, Unavailable
from unbend_service.domain.frames import Frame, PixelFormat, frame_size_bytes


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
    """Turns FFmpeg's errors into InvalidImage, whose message starts with ``what``; errors of files stay OSError.

    Those of files name their file; those of addresses do not, and would leave everybody guessing.
    """
    av = load_av()
    try:
        yield
    except av.error.FFmpegError as error:
        if isinstance(error, FileNotFoundError | PermissionError | IsADirectoryError) and error.filename:
            raise
        raise InvalidImage(f"{what}: {error.strerror or error}") from error


def frame_of(picture: Any) -> Frame:
    """An i420 copy of a yuv420p ``av.VideoFrame``."""
    data = np.empty(frame_size_bytes(PixelFormat.I420, picture.width, picture.height), np.uint8)
    frame = Frame(PixelFormat.I420, picture.width, picture.height, data)
    for out, plane in zip(frame.plane_arrays(), picture.planes, strict=True):
        rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)
        out[...] = rows[: out.shape[0], : out.shape[1]]
    return frame


def picture_of(frame: Frame) -> Any:
    """A yuv420p ``av.VideoFrame`` with a copy of an i420 frame."""
    picture = load_av().VideoFrame(frame.width, frame.height, "yuv420p")
    for samples, plane in zip(frame.plane_arrays(), picture.planes, strict=True):
        rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)
        rows[: samples.shape[0], : samples.shape[1]] = samples
    return picture
