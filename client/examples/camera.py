"""Straighten a camera as it films: a webcam, an RTSP or HTTP stream, or a file.

    python camera.py rtsp://192.0.2.7/stream --out straight.mp4
    python camera.py /dev/video0 --input-format v4l2 --latest

The grid is estimated over the first frames, which pass through as they are meanwhile. Without --out the frames are only
counted: put what you want to do with them where it says so. Needs `pip install 'unbend[video]'`.
"""

from __future__ import annotations

import argparse
import sys
import time
from fractions import Fraction
from itertools import islice

import av

import unbend

MICROSECOND = Fraction(1, 1_000_000)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", help="device, URL or file")
    parser.add_argument("--out", help="file to write, .mp4 or .mkv (H.264)")
    parser.add_argument("--input-format", help="v4l2 for a webcam on Linux, avfoundation on a Mac")
    parser.add_argument("--latest", action="store_true", help="rather skip frames than fall behind")
    parser.add_argument("--frames", type=int, help="stop after so many")
    parser.add_argument("--target", default="127.0.0.1:50051", help="host:port of Unbend [%(default)s]")
    options = parser.parse_args()

    with av.open(options.source, format=options.input_format) as camera, unbend.Client(options.target) as client:
        video = camera.streams.video[0]
        width, height = video.codec_context.width, video.codec_context.height
        delivery = "latest" if options.latest else "lossless"
        frames = islice(camera.decode(video), options.frames)
        out = av.open(options.out, "w") if options.out else None
        track = None
        shown, start = 0, time.monotonic()
        with client.stream(width, height, "i420", delivery=delivery, while_estimating="pass_through") as stream:
            for result in stream.correct(frames):
                if result.image is None:  # dropped for a newer one, or failed: result.error says why
                    continue
                shown += 1
                if out is None:
                    continue  # result.image is the straight frame: show it, look for people in it, ...
                if track is None:
                    track = out.add_stream("libx264", rate=video.average_rate or 25)
                    track.width, track.height, track.pix_fmt = width, height, "yuv420p"
                    track.codec_context.time_base = MICROSECOND
                frame = result.to_av()
                frame.pts, frame.time_base = result.timestamp_us, MICROSECOND
                out.mux(track.encode(frame))
        if out is not None:
            if track is not None:
                out.mux(track.encode(None))
            out.close()
        grid = stream.grid.grid_id if stream.grid else "none"
        print(f"{shown} frames, {shown / (time.monotonic() - start):.1f} a second, grid {grid}", file=sys.stderr)


if __name__ == "__main__":
    main()
