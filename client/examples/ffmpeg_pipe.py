"""Straighten raw video between two ffmpegs: i420 frames in on standard input, out on standard output.

    ffmpeg -i bent.mp4 -f rawvideo -pix_fmt yuv420p - \\
      | python ffmpeg_pipe.py 1280 720 \\
      | ffmpeg -f rawvideo -pix_fmt yuv420p -s 1280x720 -r 30 -i - straight.mp4

Needs nothing but the client. `unbend video` does the same in one command, audio and timestamps included.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from typing import BinaryIO

import unbend


def read_frames(pipe: BinaryIO, size_bytes: int) -> Iterator[bytes]:
    """Frames until the pipe ends; a torn last one is an error."""
    while frame := pipe.read(size_bytes):
        if len(frame) < size_bytes:
            raise SystemExit(f"the input ended within a frame: {len(frame)} of {size_bytes} bytes")
        yield frame


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("width", type=int, help="pixels, even")
    parser.add_argument("height", type=int, help="pixels, even")
    parser.add_argument("--fit", default="crop", help="crop, full, keep, or 0..1 [%(default)s]")
    parser.add_argument("--target", default="127.0.0.1:50051", help="host:port of Unbend [%(default)s]")
    options = parser.parse_args()
    if options.width % 2 or options.height % 2:
        parser.error("i420 wants an even width and height")

    size_bytes = options.width * options.height * 3 // 2
    with (
        unbend.Client(options.target) as client,
        client.stream(options.width, options.height, "i420", fit=options.fit) as stream,
    ):
        for result in stream.correct(read_frames(sys.stdin.buffer, size_bytes)):
            if result.image is None:
                raise SystemExit(f"frame {result.index}: {result.error}")
            sys.stdout.buffer.write(result.image)
    sys.stdout.buffer.flush()


if __name__ == "__main__":
    main()
