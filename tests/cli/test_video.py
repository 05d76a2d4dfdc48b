"""The whole command, on small videos that are made here."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.cli.videos import FRAMES, GRID, HEIGHT, WIDTH, av, made, psnr_db, run, told
from unbend_service.domain.dense_maps import pixel_maps
from unbend_service.domain.fit import CROP, with_fit

pytestmark = pytest.mark.usefixtures("cpu_renderer")


def test_only_the_picture_changes(tmp_path: Path, grid_file: Path) -> None:
    """Same frames at the same times, same sound byte for byte, same colour description; the pictures are ours."""
    source, target = made(tmp_path / "in.mp4"), tmp_path / "out.mp4"
    summary = json.loads(run(source, target, "--grid", grid_file, "--crf", 4, "--json"))
    before, after = told(source), told(target)
    assert summary["frames"] == FRAMES
    assert summary["grid_id"] == GRID.id
    assert after["codec"] == "h264"
    for kept in ("times", "sound", "colours", "size", "rotation"):
        assert after[kept] == before[kept], kept
    maps = pixel_maps(with_fit(GRID, CROP), WIDTH, HEIGHT)
    for ours, original in zip(after["pictures"], before["pictures"], strict=True):
        drawn = cv2.remap(original, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        assert psnr_db(ours, drawn) > 33
        assert psnr_db(ours, original) < 28


def test_an_estimate_is_made_once_over_frames_of_the_whole_file(tmp_path: Path) -> None:
    """Without a grid one is estimated; the summary says which and how sure it is."""
    summary = json.loads(run(made(tmp_path / "in.mp4"), tmp_path / "out.mkv", "--json"))
    assert summary["frames"] == FRAMES
    assert summary["outcome"] in ("corrected", "left_alone")
    assert 0 <= summary["confidence"] <= 1


def test_uneven_times_and_rotation_stay(tmp_path: Path, grid_file: Path) -> None:
    """A telephone's video: variable frame rate, and a flag that turns it upright."""
    pts = [int(1000 * index + 400 * (index % 3)) for index in range(FRAMES)]
    source, target = made(tmp_path / "in.mp4", pts=pts, rotation=90), tmp_path / "out.mp4"
    run(source, target, "--grid", grid_file)
    before, after = told(source), told(target)
    assert before["rotation"] != 0
    assert after["rotation"] == before["rotation"]
    np.testing.assert_allclose(after["times"], before["times"], atol=2e-3)


@pytest.mark.parametrize(
    ("codec", "suffix", "preset"),
    [("hevc", ".mkv", "ultrafast"), ("vp9", ".mkv", "8"), ("av1", ".mp4", "12")],
)
def test_every_codec_is_written(tmp_path: Path, grid_file: Path, codec: str, suffix: str, preset: str) -> None:
    """Number and times of the frames, and the sound in step with them, whatever the codec.

    Matroska has no time before 0: like ffmpeg, all of it is moved by the lead-in of the sound.
    """
    source, target = made(tmp_path / "in.mp4"), tmp_path / f"out{suffix}"
    run(source, target, "--grid", grid_file, "--codec", codec, "--preset", preset)
    before, after = told(source), told(target)
    assert after["codec"] == codec
    moved = after["times"][0] - before["times"][0]
    assert after["sound"][0][0] - before["sound"][0][0] == pytest.approx(moved, abs=2e-3)
    np.testing.assert_allclose(np.array(after["times"]) - moved, before["times"], atol=2e-3)
    assert [data for _, data in after["sound"]] == [data for _, data in before["sound"]]


def test_what_cannot_be_kept_is_said(tmp_path: Path, grid_file: Path) -> None:
    """WebM holds no AAC, and ten bits become eight: the summary says both."""
    source = made(tmp_path / "in.mp4", pix_fmt="yuv420p10le")
    summary = json.loads(run(source, tmp_path / "out.webm", "--grid", grid_file, "--preset", "8", "--json"))
    assert any("8-bit" in note for note in summary["notes"])
    assert any("audio aac was left out" in note for note in summary["notes"])
    assert told(tmp_path / "out.webm")["codec"] == "vp9"


def test_a_preview_shows_both(tmp_path: Path, grid_file: Path) -> None:
    """The left half is the original, the right half the result."""
    source, target = made(tmp_path / "in.mp4"), tmp_path / "out.mp4"
    run(source, target, "--grid", grid_file, "--preview", "--crf", 4)
    after = told(target)
    assert after["size"] == (2 * WIDTH, HEIGHT)
    assert psnr_db(after["pictures"][3][:, :WIDTH], told(source)["pictures"][3]) > 33


def test_it_sits_in_a_pipe(tmp_path: Path, grid_file: Path) -> None:
    """y4m in, y4m out, nothing else on standard output."""
    source = made(tmp_path / "in.mp4")
    with av.open(str(source)) as container:
        pictures = [picture.to_ndarray(format="yuv420p").tobytes() for picture in container.decode(video=0)]
    y4m = f"YUV4MPEG2 W{WIDTH} H{HEIGHT} F24:1 Ip A1:1 C420jpeg\n".encode()
    y4m += b"".join(b"FRAME\n" + picture for picture in pictures)
    command = [sys.executable, "-m", "unbend", "video", "-", "-", "--grid", str(grid_file), "--workers", "1"]
    done = subprocess.run(command, input=y4m, capture_output=True, timeout=60, check=True)
    with av.open(io.BytesIO(done.stdout), format="yuv4mpegpipe") as container:
        answered = [picture.to_ndarray(format="yuv420p") for picture in container.decode(video=0)]
    assert len(answered) == FRAMES
    assert answered[0].shape == (HEIGHT * 3 // 2, WIDTH)


def test_ctrl_c_leaves_a_file_that_plays(tmp_path: Path, grid_file: Path) -> None:
    """The frames up to the interrupt are there, the file is closed, and the exit code says what happened."""
    pictures = b"".join(b"FRAME\n" + bytes(WIDTH * HEIGHT * 3 // 2) for _ in range(10))
    header = f"YUV4MPEG2 W{WIDTH} H{HEIGHT} F24:1 Ip A1:1 C420jpeg\n".encode()
    target = tmp_path / "out.mp4"
    command = [sys.executable, "-m", "unbend", "video", "-", str(target), "--grid", str(grid_file), "--workers", "1"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin is not None
        process.stdin.write(header)
        interrupted = False
        deadline = time.monotonic() + 60
        while process.poll() is None and time.monotonic() < deadline:
            try:
                process.stdin.write(pictures)
                process.stdin.flush()
            except BrokenPipeError:
                break
            if not interrupted and target.exists():
                os.kill(process.pid, signal.SIGINT)
                interrupted = True
        assert process.wait(30) == 130
    assert len(told(target)["times"]) > 0


@pytest.mark.parametrize(
    ("arguments", "code", "sentence"),
    [
        (("none.mp4", "out.mp4"), 1, "No such file"),
        (("text.mp4", "out.mp4"), 3, "cannot be read"),
        (("in.mp4", "out.xyz"), 3, ".mkv"),
        (("in.mp4", "in.mp4"), 2, "--overwrite"),
        (("in.mp4", "in.mp4", "--overwrite"), 3, "same file"),
        (("in.mp4", "out.mp4", "--crf", "60"), 3, "0..51"),
        (("in.mp4", "out.webm", "--codec", "h264"), 3, "--codec"),
        (("in.mp4", "out.mp4", "--preset", "quickest"), 3, "cannot be written"),
        (("in.mp4", "-", "--json"), 3, "--json"),
    ],
)
def test_mistakes_are_sentences(
    tmp_path: Path,
    grid_file: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: tuple[str, ...],
    code: int,
    sentence: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    made(Path("in.mp4"))
    Path("text.mp4").write_text("not a video")
    assert sentence in run(*arguments, "--grid", grid_file, code=code)
    assert not Path("out.mp4").exists()
