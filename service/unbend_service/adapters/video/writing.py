"""Writing a video with PyAV."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from unbend_service.adapters.video.encoders import ENCODERS, VideoCodec, encoder_options
from unbend_service.adapters.video.pyav import av_errors, load_av, picture_of
from unbend_service.adapters.video.reading import PyavReader, Timing
from unbend_service.application.video import Passenger, Picture
from unbend_service.domain.errors import InvalidOption
from unbend_service.domain.frames import Frame

_MP4 = (".mp4", ".mov", ".m4v")


class PyavWriter:
    """Port VideoWriter: a file whose video is encoded anew and whose other streams are copied.

    Timestamps, colour description, aspect, orientation and chapters are those of ``reader``. The file is opened with
    the first picture, whose size it takes, or by :meth:`copy_video`.

    Args:
        target: where to; the suffix chooses the container.
        crf, preset: of the encoder; its defaults if None.

    Raises:
        InvalidOption: a container or codec that FFmpeg cannot write, or a quality out of range.
    """

    def __init__(
        self, target: Path, reader: PyavReader, codec: VideoCodec, crf: int | None = None, preset: str | None = None
    ) -> None:
        self._av = load_av()
        self._target = target
        self._reader = reader
        self._codec = codec
        self._options = encoder_options(codec, crf, preset)
        self.notes: list[str] = []
        self._early: list[Passenger] = []
        self._container: Any = None
        self._stream: Any = None
        self._copies: dict[int, Any] = {}
        self._last_pts: int | None = None
        try:
            self._av.ContainerFormat(self._format_name(), "w")
        except ValueError as error:
            raise InvalidOption(
                f"OUT ends in {target.suffix!r}.", allowed=".mp4, .mov, .mkv, .webm, .avi, .ts"
            ) from error

    def copy_video(self) -> bool:
        """Opens the file for the packets of the video as they are: :meth:`write_passenger` takes them too.

        Returns:
            False, and nothing is done, if the container does not hold the codec of the input, or not its packets.
        """
        if not self._reader.can_copy:
            return False
        with av_errors(f"{self._target} cannot be written"):
            container = self._created()
            try:
                stream = container.add_stream_from_template(self._reader.stream, opaque=True)
            except ValueError:
                container.close()
                return False
            self._copies[self._reader.stream.index] = stream
            self._started(container, stream)
        return True

    def write_picture(self, picture: Picture) -> None:
        """Encodes one picture."""
        with av_errors(f"{self._target} cannot be written"):
            if self._container is None:
                self._open(picture.frame)
            frame = self._video_frame(picture)
            self._container.mux(self._stream.encode(frame))

    def write_passenger(self, passenger: Passenger) -> None:
        """Copies one packet; those that come before the first picture wait for it."""
        if self._container is None:
            self._early.append(passenger)
            return
        packet: Any = passenger.packet
        copy = self._copies.get(packet.stream.index)
        if copy is not None:
            packet.stream = copy
            with av_errors(f"{self._target} cannot be written"):
                self._container.mux(packet)

    def close(self) -> None:
        """Writes what the encoder holds back and the end of the file, so that it can be played whatever happened."""
        if self._container is None:
            return
        container, self._container = self._container, None
        with av_errors(f"{self._target} cannot be written"):
            try:
                if self._reader.stream.index not in self._copies:
                    container.mux(self._stream.encode(None))
            finally:
                container.close()

    def _open(self, frame: Frame) -> None:
        container = self._created()
        reader, encoder = self._reader, ENCODERS[self._codec]
        try:
            stream = container.add_stream(encoder.library, rate=reader.rate, options=self._options)
        except ValueError as error:
            container.close()
            raise InvalidOption(
                f"{self._target.suffix} does not hold {self._codec}.", allowed="--codec, or another suffix of OUT"
            ) from error
        source = reader.stream.codec_context
        context = stream.codec_context
        stream.width, stream.height, stream.pix_fmt = frame.width, frame.height, "yuv420p"
        context.time_base = stream.time_base = reader.stream.time_base
        for name in ("color_range", "color_primaries", "color_trc", "colorspace"):
            setattr(context, name, getattr(source, name))
        if source.sample_aspect_ratio:
            context.sample_aspect_ratio = source.sample_aspect_ratio
        if self._codec is VideoCodec.HEVC and self._target.suffix.lower() in _MP4:
            context.codec_tag = "hvc1"  # the tag that Apple's players ask for
        self._started(container, stream)

    def _created(self) -> Any:
        options = {"movflags": "+faststart"} if self._target.suffix.lower() in _MP4 else {}
        return self._av.open(str(self._target), "w", format=self._format_name(), options=options)

    def _started(self, container: Any, stream: Any) -> None:
        """What both ways of writing the video have in common: everything but its packets."""
        reader = self._reader
        if reader.display_matrix is not None:
            stream.set_display_matrix(reader.display_matrix)
        stream.metadata.update(reader.stream.metadata)
        container.metadata.update(reader.container.metadata)
        container.set_chapters(reader.container.chapters())
        self._container, self._stream = container, stream
        for passenger in reader.passengers:
            self._add_copy(passenger)
        early, self._early = self._early, []
        for waiting in early:
            self.write_passenger(waiting)

    def _add_copy(self, passenger: Any) -> None:
        try:
            copy = self._container.add_stream_from_template(passenger)
        except ValueError:
            codec_id = passenger.codec_context.name
            self.notes.append(f"{passenger.type} {codec_id} was left out: {self._target.suffix} does not hold it.")
            return
        copy.metadata.update(passenger.metadata)
        copy.disposition = int(passenger.disposition)
        self._copies[passenger.index] = copy

    def _video_frame(self, picture: Picture) -> Any:
        out = picture_of(picture.frame)
        timing = picture.timing
        pts = timing.pts if isinstance(timing, Timing) else None
        step = max(1, round(1 / (self._reader.rate * self._reader.stream.time_base)))
        if pts is None:
            pts = 0 if self._last_pts is None else self._last_pts + step
        if self._last_pts is not None and pts <= self._last_pts:
            pts = self._last_pts + 1  # encoders refuse time that stands still
        self._last_pts = pts
        out.pts, out.time_base = pts, self._reader.stream.time_base
        out.duration = (timing.duration if isinstance(timing, Timing) else 0) or step
        return out

    def _format_name(self) -> str | None:
        names = {".mkv": "matroska", ".mp4": "mp4", ".m4v": "mp4", ".mov": "mov", ".webm": "webm", ".ts": "mpegts"}
        return names.get(self._target.suffix.lower(), self._target.suffix.removeprefix("."))
