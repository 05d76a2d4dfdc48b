"""Writing y4m, the uncompressed stream that ffmpeg and encoders take through a pipe."""

from __future__ import annotations

from fractions import Fraction
from typing import BinaryIO

from unbend_service.application.video import Passenger, Picture


class Y4mWriter:
    """Port VideoWriter: 8-bit 4:2:0 at a constant rate, without sound.

    Args:
        out: where to; left open.
        rate: frames a second.
        full_range: whether luma goes from 0 to 255, as in JPEG.
        aspect: width of a pixel by its height; None if nobody knows.
    """

    def __init__(
        self, out: BinaryIO, rate: Fraction, *, full_range: bool = False, aspect: Fraction | None = None
    ) -> None:
        self._out = out
        self._rate = rate
        self._full_range = full_range
        self._aspect = aspect or Fraction(0)
        self._started = False
        self.notes: list[str] = []

    def write_picture(self, picture: Picture) -> None:
        frame = picture.frame
        if not self._started:
            rate = f"{self._rate.numerator}:{self._rate.denominator}"
            # where chroma lies: in the middle in JPEG, on the left in what else is 8-bit 4:2:0
            colours = "C420jpeg XCOLORRANGE=FULL" if self._full_range else "C420mpeg2 XCOLORRANGE=LIMITED"
            aspect = f"{self._aspect.numerator}:{self._aspect.denominator if self._aspect else 0}"
            header = f"YUV4MPEG2 W{frame.width} H{frame.height} F{rate} Ip A{aspect} {colours}\n"
            self._out.write(header.encode())
            self._started = True
        self._out.write(b"FRAME\n")
        self._out.write(frame.data.tobytes())

    def write_passenger(self, passenger: Passenger) -> None:
        """Sound has no place in y4m."""
        note = "Sound and subtitles were left out: y4m does not hold them."
        if note not in self.notes:
            self.notes.append(note)

    def copy_video(self) -> bool:
        """y4m holds no packets: its pictures are always written anew, which loses nothing."""
        return False

    def close(self) -> None:
        self._out.flush()
