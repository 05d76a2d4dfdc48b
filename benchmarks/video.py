"""`unbend video` beside ffmpeg's remap filter: one file, one map, one encoder; and what a minute of video keeps."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import zipfile
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.companions import MissingProgram
from benchmarks.material import barrel_grid
from benchmarks.measurement import Report, by_turns
from unbend_service.adapters.exchange.ffmpeg import filter_graph
from unbend_service.adapters.exchange.files import ExchangeFiles
from unbend_service.domain.dense_maps import pixel_maps
from unbend_service.domain.exchange import DenseMap, ExportFormat
from unbend_service.domain.grid import Grid
from unbend_service.domain.records import GridRecord

WIDTH, HEIGHT, FPS = 1920, 1080, 30
PHOTOGRAPH = Path(__file__).parent.parent / "docs/pictures/bent.jpg"
ENCODER = ("-c:v", "libx264", "-preset", "ultrafast", "-crf", "18")
#: The plain filter. It takes one map for all planes, and therefore frames that are not subsampled.
NEAREST = "[0:v]format=yuv444p[v];[v][1:v][2:v]remap,format=yuv420p[straight]"
BAR_NEAREST, BAR_EXPORT = 1.0, 1.3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the suite."""
    parser.add_argument("--runs", type=int, default=3, help="turns a case")
    parser.add_argument("--minute-s", type=int, default=60, help="seconds of the file whose streams are compared")
    parser.add_argument("--turn-s", type=int, default=15, help="seconds of the file that is timed by turns")


def run(arguments: argparse.Namespace) -> Report:
    """Whole commands, their start among it: reading, decoding, remapping, encoding, writing, sound copied."""
    report = Report("video")
    runs, minute_s, turn_s = (2, 2, 0.2) if arguments.quick else (arguments.runs, arguments.minute_s, arguments.turn_s)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        grid = barrel_grid()
        (folder / "grid.json").write_bytes(ExchangeFiles().write_record(GridRecord(grid)).body)
        _write_maps(folder, grid)
        _minute(report, folder, minute_s)
        _turns(report, folder, turn_s, runs, NEAREST, "nearest-", "nearest neighbour", BAR_NEAREST)
        _turns(report, folder, turn_s, runs, filter_graph(), "", "the exported map, four-fold", BAR_EXPORT)
    return report


def _minute(report: Report, folder: Path, seconds: int) -> None:
    """One file through `unbend video`, both ends described by ffprobe."""
    source, target = folder / "minute.mp4", folder / "minute-straight.mp4"
    _film(source, seconds)
    summary = json.loads(_run(_ours(folder, source, target), folder).stdout)
    before, after = _probe(source), _probe(target)
    report.rows.append(
        {
            "name": f"{seconds} s of 1080p{FPS} h264 with sound through unbend video",
            "frames_per_s": summary["frames"] / summary["seconds"],
            "before": before,
            "after": after,
        }
    )
    label = f"{seconds} s of video:"
    report.add_ratio(f"{label} frames too many or too few", abs(after["frames"] - before["frames"]), at_most=0)
    report.add_ratio(f"{label} seconds longer or shorter", abs(after["duration_s"] - before["duration_s"]), at_most=0)
    report.add_ratio(f"{label} audio codecs that changed", int(after["audio"] != before["audio"]), at_most=0)


def _turns(
    report: Report, folder: Path, seconds: float, runs: int, graph: str, maps: str, peer_name: str, bar: float
) -> None:
    source, ours, peer = folder / f"{seconds}.mp4", folder / "ours.mp4", folder / "peer.mp4"
    _film(source, seconds)
    frames = round(seconds * FPS)
    theirs = ["ffmpeg", "-v", "error", "-y", "-i", str(source), "-i", f"{maps}xmap.pgm", "-i", f"{maps}ymap.pgm"]
    theirs += ["-filter_complex", graph, "-map", "[straight]", "-map", "0:a", *ENCODER, "-c:a", "copy", str(peer)]
    pair = by_turns(
        lambda: _run(_ours(folder, source, ours), folder), lambda: _run(theirs, folder), runs, warm_up=0
    ).per(frames)
    counted = _probe(ours)["frames"], _probe(peer)["frames"]
    if counted != (frames, frames):
        raise RuntimeError(f"{counted} of {frames} frames were written by us and by ffmpeg")
    name = f"unbend video, {seconds} s of 1080p{FPS} h264 / ffmpeg remap filter, {peer_name}"
    report.add_pair(
        name,
        pair,
        peer_name="ffmpeg, the same file, map and encoder",
        frames_per_s=1 / pair.ours.median_s,
        peer_frames_per_s=1 / pair.peer.median_s,
    )
    report.add_ratio(f"unbend video / ffmpeg remap filter, {peer_name}, frames/s", 1 / pair.ratio, at_least=bar)


def _film(path: Path, seconds: float) -> None:
    """h264 and AAC: a window that wanders over a photograph."""
    window = f"crop={WIDTH}:{HEIGHT}:(iw-ow)*(0.5+0.5*sin(t)):(ih-oh)*(0.5+0.5*cos(t/2))"
    command = ["ffmpeg", "-v", "error", "-y", "-loop", "1", "-framerate", str(FPS), "-i", str(PHOTOGRAPH)]
    command += ["-f", "lavfi", "-i", "sine=frequency=440:sample_rate=48000", "-t", str(seconds)]
    command += ["-vf", f"scale=2400:-2,{window},format=yuv420p", *ENCODER, "-c:a", "aac", str(path)]
    _run(command, path.parent)


def _ours(folder: Path, source: Path, target: Path) -> list[str]:
    options = ["--grid", str(folder / "grid.json"), "--fit", "keep", "--codec", "h264", "--crf", "18"]
    options += ["--preset", "ultrafast", "--overwrite", "--quiet", "--json"]
    return [sys.executable, "-m", "unbend", "video", str(source), str(target), *options]


def _run(command: list[str], folder: Path) -> subprocess.CompletedProcess[bytes]:
    environment = os.environ | {"UNBEND_RENDERER": "cpu"}
    try:
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, check=False)
    except FileNotFoundError:
        raise MissingProgram(f"{command[0]} is not installed (Debian: apt-get install ffmpeg)") from None
    if done.returncode:
        raise RuntimeError(f"{' '.join(command[:4])} ended with {done.returncode}: {done.stderr.decode()[-1000:]}")
    return done


def _probe(path: Path) -> dict[str, Any]:
    """Frames (counted by decoding), seconds and codecs, as ffprobe says."""
    command = ["ffprobe", "-v", "error", "-count_frames", "-show_entries"]
    command += ["stream=codec_type,codec_name,nb_read_frames:format=duration", "-of", "json", str(path)]
    told = json.loads(_run(command, path.parent).stdout)
    streams = {stream["codec_type"]: stream for stream in told["streams"]}
    return {
        "frames": int(streams["video"]["nb_read_frames"]),
        "duration_s": float(told["format"]["duration"]),
        "video": streams["video"]["codec_name"],
        "audio": streams["audio"]["codec_name"] if "audio" in streams else None,
    }


def _write_maps(folder: Path, grid: Grid) -> None:
    """The exported pair, and the same map for the filter as it comes, which takes the nearest pixel."""
    dense = DenseMap(*pixel_maps(grid, WIDTH, HEIGHT))
    with zipfile.ZipFile(BytesIO(ExchangeFiles().write_map(ExportFormat.FFMPEG, dense).body)) as archive:
        archive.extractall(folder)
    for name, positions, length in (("xmap", dense.map_x, WIDTH), ("ymap", dense.map_y, HEIGHT)):
        nearest = np.rint(positions).clip(0, length - 1).astype(">u2")
        (folder / f"nearest-{name}.pgm").write_bytes(f"P5\n{WIDTH} {HEIGHT}\n65535\n".encode() + nearest.tobytes())
