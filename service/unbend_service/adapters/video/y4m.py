"""Writing y4m, the uncompressed stream that ffmpeg and encoders take through a pipe."""

from __future__ import annotations

from fractions import Fraction
from typing import BinaryIO

from unbend_service.application.video import Passenger, Picture

_FULL_RANGE = 2


class Y4mWriter:
    """Port VideoWriter: 8-bit 4:2:0 at a constant rate, without sound.

    Args:
        out: where to; left open.
        rate: frames a second.
        full_range: whether luma goes from 0 to 255.
    """

    def __init__(self, out: BinaryIO, rate: Fraction, *, full_range: bool = False) -> None:
        self._out = out
        self._rate = rate
        self._full_range = full_range
        self._started = False
        self.notes: list[str] = []

    def write_picture(self, picture: Picture) -> None:
        frame = picture.frame
        if not self._started:
            rate = f"{self._rate.numerator}:{self._rate.denominator}"
            colour = "FULL" if self._full_range else "LIMITED"
            header = f"YUV4MPEG2 W{frame.width} H{frame.height} F{rate} Ip A0:0 C420jpeg XCOLORRANGE={colour}\n"
            self._out.write(header.encode())
            self._started = True
        self._out.write(b"FRAME\n")
        self._out.write(frame.data.tobytes())

    def write_passenger(self, passenger: Passenger) -> None:
        """Sound has no place in y4m."""
        note = "Sound and subtitles were left out: y4m does not hold them."
        if note not in self.notes:
            self.notes.append(note)

    def close(self) -> None:
        self._out.flush()
