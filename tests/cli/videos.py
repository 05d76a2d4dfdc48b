"""Small videos that the tests of ``unbend video`` make, and what a player sees of them."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.domain.lenses import BARREL, radial
from unbend_service.cli import app
from unbend_service.domain.grid import Grid

av = pytest.importorskip("av", reason="the extra [video] is not installed")

WIDTH, HEIGHT, FRAMES = 128, 96, 24
GRID = Grid.from_map(radial(BARREL), 33, 33)


def scene(index: int) -> np.ndarray:
    """(HEIGHT, WIDTH, 3) uint8: smooth hills that wander; the frame's number lies in the brightness of its middle."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    red = 120 + 80 * np.sin((x + 2 * index) / 9) * np.cos(y / 11)
    green = 120 + 80 * np.cos((x - index) / 13 + y / 8)
    return np.stack([red, green, np.full_like(red, 40 + 6 * index)], -1).astype(np.uint8)


def made(
    path: Path,
    *,
    codec: str = "libx264",
    pix_fmt: str = "yuv420p",
    pts: list[int] | None = None,
    rotation: int = 0,
) -> Path:
    """A video of FRAMES frames at 24 a second with two channels of sound."""
    with av.open(str(path), "w") as container:
        video = container.add_stream(codec, rate=24)
        video.width, video.height, video.pix_fmt = WIDTH, HEIGHT, pix_fmt
        context = video.codec_context
        context.time_base = Fraction(1, 24000)
        context.color_range, context.colorspace, context.color_primaries, context.color_trc = 1, 1, 1, 1
        if rotation:
            video.set_display_rotation(rotation)
        audio = container.add_stream("aac", rate=48000, layout="stereo")
        for index in range(FRAMES):
            frame = av.VideoFrame.from_ndarray(scene(index), format="rgb24").reformat(format=pix_fmt)
            frame.pts = pts[index] if pts else index * 1000
            frame.time_base = Fraction(1, 24000)
            container.mux(video.encode(frame))
        container.mux(video.encode(None))
        for start in range(0, 48000, 1024):
            tone = np.sin(2 * np.pi * 440 * np.arange(start, start + 1024) / 48000).astype(np.float32)
            sound = av.AudioFrame.from_ndarray(np.stack([tone, tone]), format="fltp", layout="stereo")
            sound.sample_rate, sound.pts = 48000, start
            container.mux(audio.encode(sound))
        container.mux(audio.encode(None))
    return path


def told(path: Path) -> dict[str, Any]:
    """What a player sees: times and pictures of the video, and the raw bytes of its sound."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        pictures = list(container.decode(video=0))
        about = {
            "codec": context.codec.canonical_name,
            "times": [round(float(picture.time), 4) for picture in pictures],
            "colours": (context.color_range, context.colorspace, context.color_primaries, context.color_trc),
            "rotation": pictures[0].rotation,
            "size": (pictures[0].width, pictures[0].height),
            "pictures": [picture.to_ndarray(format="rgb24") for picture in pictures],
        }
    with av.open(str(path)) as container:
        sound = container.streams.audio[0] if container.streams.audio else None
        packets = [] if sound is None else [packet for packet in container.demux(sound) if packet.size]
        about["sound"] = [(round(float(packet.pts * packet.time_base), 4), bytes(packet)) for packet in packets]
    return about


def psnr_db(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.maximum(((a.astype(float) - b) ** 2).mean(), 1e-9)))


def run(*arguments: object, code: int = 0) -> str:
    """``unbend video`` in this process; its output."""
    result = CliRunner().invoke(app, ["video", *map(str, arguments), "--workers", "1"])
    assert result.exit_code == code, result.output
    return result.output
