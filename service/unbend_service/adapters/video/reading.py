"""Reading a video with PyAV."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from unbend_service.adapters.video.pyav import av_errors, load_av
from unbend_service.application.video import Passenger, Picture
from unbend_service.domain.errors import InvalidImage
from unbend_service.domain.frames import Frame, PixelFormat, frame_size_bytes

STANDARD_INPUT = "-"
_I420 = ("yuv420p", "yuvj420p")
#: Broken packets in a row after which the input is given up.
_MOST_BROKEN = 100


@dataclass(frozen=True, slots=True)
class Timing:
    """When a picture is shown, in units of the time base of its stream; None if the stream does not say."""

    pts: int | None
    duration: int


class PyavReader:
    """Port VideoReader: the first video stream as i420, sound and subtitles as packets.

    Args:
        source: a path, a URL that FFmpeg opens (rtsp, http ...), or ``-`` for y4m on standard input.

    Raises:
        InvalidImage: not a video that FFmpeg reads.
        OSError: no such file.
        Unavailable: PyAV is not installed.
    """

    def __init__(self, source: str) -> None:
        self._av = load_av()
        self.source = source
        self.notes: list[str] = []
        with av_errors(f"{source} cannot be read"):
            self.container = _opened(self._av, source)
        if not self.container.streams.video:
            self.container.close()
            raise InvalidImage(f"{source} has no video.")
        self.stream = self.container.streams.video[0]
        self.stream.thread_type = "AUTO"
        context = self.stream.codec_context
        self.width, self.height = int(context.width), int(context.height)
        if not self.width or not self.height:
            self.container.close()
            raise InvalidImage(f"{source} does not say how large its pictures are.")
        self.rate = Fraction(self.stream.average_rate or self.stream.guessed_rate or 25)
        self.passengers = [
            stream
            for stream in self.container.streams
            if stream.type in ("audio", "subtitle") and stream.codec_context is not None
        ]
        self.rotation = 0
        self._first: Sequence[Picture | Passenger] = ()
        self._items = self._demuxed()
        self._broken = 0

    @property
    def frames_expected(self) -> int | None:
        """How many pictures there will be, as far as the container says."""
        if self.stream.frames:
            return int(self.stream.frames)
        if self.stream.duration and self.stream.time_base:
            return int(self.stream.duration * self.stream.time_base * self.rate + Fraction(1, 2))
        if self.container.duration:
            return int(Fraction(self.container.duration, 1_000_000) * self.rate + Fraction(1, 2))
        return None

    def read(self) -> Sequence[Picture | Passenger]:
        """See :class:`~unbend_service.application.video.VideoReader`."""
        with av_errors(f"{self.source} cannot be read"):
            return next(self._items, ())

    def samples(self, count: int) -> list[Frame]:
        """Up to ``count`` pictures spread over a file, read through a second opening of it; none of other inputs."""
        duration = self.container.duration
        if self.source == STANDARD_INPUT or "://" in self.source or not duration:
            return []
        found: list[Frame] = []
        with av_errors(f"{self.source} cannot be read"), _opened(self._av, self.source) as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            start = container.start_time or 0
            for share in (np.arange(count) + 0.5) / count:
                try:
                    container.seek(int(start + duration * share), backward=True)
                    picture = next(container.decode(stream), None)
                except (self._av.error.InvalidDataError, self._av.error.PermissionError):
                    continue
                if picture is not None and (picture.width, picture.height) == (self.width, self.height):
                    found.append(self._frame(picture))
        return found

    def close(self) -> None:
        """Frees the decoder and the file."""
        self.container.close()

    def _demuxed(self) -> Iterator[Sequence[Picture | Passenger]]:
        for packet in self.container.demux([self.stream, *self.passengers]):
            if packet.stream is not self.stream:
                if packet.dts is not None:
                    yield [Passenger(packet)]
                continue
            try:
                pictures = packet.decode()
            except self._av.error.InvalidDataError:
                self._broken += 1
                if self._broken > _MOST_BROKEN:
                    raise
                self._note("Broken packets were skipped.")
                continue
            if pictures:
                self._broken = 0
                yield [self._picture(picture) for picture in pictures]

    def _picture(self, picture: Any) -> Picture:
        if (picture.width, picture.height) != (self.width, self.height):
            raise InvalidImage(
                f"The pictures change their size, from {self.width}x{self.height} to {picture.width}x{picture.height}."
            )
        if picture.rotation:
            self.rotation = int(picture.rotation)
        if picture.interlaced_frame:
            self._note("The video is interlaced; its pictures are corrected as if they were progressive.")
        return Picture(self._frame(picture), Timing(picture.pts, int(picture.duration or 0)))

    def _frame(self, picture: Any) -> Frame:
        if picture.format.name not in _I420:
            deep = any(component.bits > 8 for component in picture.format.components)
            self._note(f"{picture.format.name} was converted to 8-bit 4:2:0{', losing depth' if deep else ''}.")
            picture = picture.reformat(format="yuv420p")
        data = np.empty(frame_size_bytes(PixelFormat.I420, self.width, self.height), np.uint8)
        frame = Frame(PixelFormat.I420, self.width, self.height, data)
        for out, plane in zip(frame.plane_arrays(), picture.planes, strict=True):
            rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)
            out[...] = rows[: out.shape[0], : out.shape[1]]
        return frame

    def _note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)


def _opened(av: Any, source: str) -> Any:
    if source == STANDARD_INPUT:
        return av.open(sys.stdin.buffer, format="yuv4mpegpipe")
    options = {"rtsp_transport": "tcp"} if source.startswith("rtsp") else {}
    return av.open(source, options=options, timeout=(20.0, 20.0) if "://" in source else None)
