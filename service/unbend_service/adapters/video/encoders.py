"""Encoders and their sane defaults."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from unbend_service.domain.errors import InvalidOption


class VideoCodec(StrEnum):
    """What the video is encoded as."""

    H264 = "h264"
    HEVC = "hevc"
    VP9 = "vp9"
    AV1 = "av1"


@dataclass(frozen=True, slots=True)
class Encoder:
    """An encoder of FFmpeg.

    Attributes:
        library: its name there.
        crf, longest_crf: quality at constant rate factor, and the worst one; lower is better.
        preset: speed, by the encoder's own names or numbers.
        speed_option: under which option the preset goes.
        options: further options, always set.
    """

    library: str
    crf: int
    longest_crf: int
    preset: str
    speed_option: str
    options: tuple[tuple[str, str], ...] = ()


ENCODERS = {
    VideoCodec.H264: Encoder("libx264", 18, 51, "medium", "preset"),
    VideoCodec.HEVC: Encoder("libx265", 20, 51, "medium", "preset", (("x265-params", "log-level=error"),)),
    VideoCodec.VP9: Encoder("libvpx-vp9", 30, 63, "4", "cpu-used", (("b", "0"), ("row-mt", "1"), ("deadline", "good"))),
    VideoCodec.AV1: Encoder("libsvtav1", 28, 63, "8", "preset"),
}


def encoder_options(codec: VideoCodec, crf: int | None, preset: str | None) -> dict[str, str]:
    """FFmpeg options of a codec. Raises InvalidOption for a quality out of range."""
    encoder = ENCODERS[codec]
    quality = encoder.crf if crf is None else crf
    if not 0 <= quality <= encoder.longest_crf:
        raise InvalidOption(f"crf={quality} is out of range.", allowed=f"0..{encoder.longest_crf} for {codec}")
    return {"crf": str(quality), encoder.speed_option: preset or encoder.preset, **dict(encoder.options)}


def default_codec(suffix: str) -> VideoCodec:
    """h264, or vp9 where the container takes no h264."""
    return VideoCodec.VP9 if suffix.lower() == ".webm" else VideoCodec.H264
