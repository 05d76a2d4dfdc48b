"""Reading a video with PyAV."""

from __future__ import annotations

import itertools
import struct
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from unbend_service.adapters.video.pyav import av_errors, frame_of, load_av, picture_of
from unbend_service.application.video import Passenger, Picture
from unbend_service.domain.errors import InvalidImage
from unbend_service.domain.frames import Frame
from unbend_service.domain.orientation import Orientation

STANDARD_INPUT = "-"
_I420 = ("yuv420p", "yuvj420p")
#: Broken packets in a row after which the input is given up.
_MOST_BROKEN = 100
_NETWORK_TIMEOUT_S = 20.0


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
        #: The display matrix of the pictures; known once one of them is, None if they have none.
        self.display_matrix: tuple[int, ...] | None = None
        self._looked = False
        self._next_dts: int | None = None
        #: Whether the packets of the video, as far as they were read, can be put into another container.
        self.can_copy = self.codec != "rawvideo"
        self._items = self._demuxed()
        self._broken = 0
        self._copies_video = False
        self._kept: list[Passenger] | None = None

    @property
    def codec(self) -> str:
        """What the video is encoded as, by FFmpeg's name of the format (h264, hevc, ...)."""
        return str(self.stream.codec_context.codec.canonical_name)

    @property
    def orientation(self) -> Orientation:
        """How the pictures are to be shown; upright until one of them has been read or sampled."""
        return Orientation() if self.display_matrix is None else Orientation.of_display_matrix(self.display_matrix)

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

    def read_ahead(self, count: int) -> list[Picture | Passenger]:
        """What comes until ``count`` pictures are there; :meth:`copy_video` can still take it back."""
        self._kept = []
        ahead: list[Picture | Passenger] = []
        while sum(isinstance(item, Picture) for item in ahead) < count and (items := self.read()):
            ahead += items
        return ahead

    def settle(self, *, copy: bool) -> list[Passenger]:
        """Whether the video itself is read as packets from now on, and those packets that were read ahead."""
        kept, self._kept = self._kept or [], None
        self._copies_video = copy
        return kept if copy else []

    def samples(self, count: int) -> list[Frame]:
        """Up to ``count`` pictures spread over the video, through a second opening of it.

        None of inputs that have no known end or cannot be sought in, such as pipes and cameras.
        """
        duration = self.container.duration
        if self.source == STANDARD_INPUT or self.source.startswith("rtsp") or not duration:
            return []
        found: list[Frame] = []
        with av_errors(f"{self.source} cannot be read"), _opened(self._av, self.source) as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            start = container.start_time or 0
            for packet in itertools.islice(container.demux(stream), count):
                self._examine(packet)
            for share in (np.arange(count) + 0.5) / count:
                try:
                    container.seek(int(start + duration * share), backward=True)
                    picture = next(container.decode(stream), None)
                except self._av.error.FFmpegError:  # no way to seek in it, or a broken place
                    continue
                if picture is not None and (picture.width, picture.height) == (self.width, self.height):
                    found.append(self._frame(picture))
        return found

    def as_shown(self, frame: Frame) -> Frame:
        """A picture as a player shows it: upright, and with square pixels of the larger side's size."""
        aspect = Fraction(self.stream.codec_context.sample_aspect_ratio or 1)
        if aspect != 1:
            width, height = frame.width, frame.height
            if aspect > 1:
                width = round(width * aspect / 2) * 2
            else:
                height = round(height / aspect / 2) * 2
            frame = frame_of(picture_of(frame).reformat(width=width, height=height))
        return self.orientation.shown(frame)

    def close(self) -> None:
        """Frees the decoder and the file."""
        self.container.close()

    def _demuxed(self) -> Iterator[Sequence[Picture | Passenger]]:
        for packet in self.container.demux([self.stream, *self.passengers]):
            is_video = packet.stream is self.stream
            passenger = Passenger(packet, is_video)
            if is_video and packet.size:
                self._examine(packet)
                if self._copies_video or self._kept is not None:
                    self._time(packet)
            if packet.dts is not None and self._kept is not None:
                self._kept.append(passenger)
            if not is_video or self._copies_video:
                if packet.dts is not None:
                    yield [passenger]
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

    def _examine(self, packet: Any) -> None:
        """Containers want to know when a packet is shown; cameras over RTP do not always say it."""
        if packet.size and packet.pts is None:
            self.can_copy = False

    def _time(self, packet: Any) -> None:
        """Says when a packet is to be decoded where the container does not: Matroska leaves it out at the beginning."""
        step = max(1, round(1 / (self.rate * self.stream.time_base)))
        if packet.dts is None and packet.pts is not None:
            first = packet.pts - step * int(self.stream.codec_context.reorder_depth)
            packet.dts = first if self._next_dts is None else min(self._next_dts, packet.pts)
        self._next_dts = None if packet.dts is None else packet.dts + step

    def _picture(self, picture: Any) -> Picture:
        if (picture.width, picture.height) != (self.width, self.height):
            raise InvalidImage(
                f"The pictures change their size, from {self.width}x{self.height} to {picture.width}x{picture.height}."
            )
        if picture.interlaced_frame:
            self._note("The video is interlaced; its pictures are corrected as if they were progressive.")
        return Picture(self._frame(picture), Timing(picture.pts, int(picture.duration or 0)))

    def _frame(self, picture: Any) -> Frame:
        if not self._looked:
            self._looked = True
            matrix = picture.side_data.get("DISPLAYMATRIX")
            self.display_matrix = None if matrix is None else struct.unpack("=9i", bytes(matrix))
        if picture.format.name not in _I420:
            deep = any(component.bits > 8 for component in picture.format.components)
            self._note(f"{picture.format.name} was converted to 8-bit 4:2:0{', losing depth' if deep else ''}.")
            picture = picture.reformat(format="yuv420p")
        return frame_of(picture)

    def _note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)


def _opened(av: Any, source: str) -> Any:
    if source == STANDARD_INPUT:
        return av.open(sys.stdin.buffer, format="yuv4mpegpipe")
    options = {"rtsp_transport": "tcp"} if source.startswith("rtsp") else {}
    timeout = (_NETWORK_TIMEOUT_S, _NETWORK_TIMEOUT_S) if "://" in source else None
    return av.open(source, options=options, timeout=timeout)
