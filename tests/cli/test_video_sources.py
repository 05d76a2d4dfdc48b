"""Where videos come from and who corrects them: pipes, HTTP, RTSP, a running server."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.acceptance.conftest import Server, start_server, stop_server
from tests.cli.videos import FRAMES, GRID, HEIGHT, WIDTH, av, made, psnr_db, run, told
from unbend_service.domain.dense_maps import pixel_maps
from unbend_service.domain.fit import CROP, with_fit

SYSTEM_PYTHON = "/usr/bin/python3"
RTSP_SERVER = Path(__file__).parent / "rtsp_server.py"
_NEEDED = "import gi; gi.require_version('GstRtspServer', '1.0'); from gi.repository import GstRtspServer"

pytestmark = pytest.mark.usefixtures("cpu_renderer")


def drawn(source: Path) -> list[np.ndarray]:
    """The pictures of a video through GRID."""
    maps = pixel_maps(with_fit(GRID, CROP), WIDTH, HEIGHT)
    pictures = told(source)["pictures"]
    return [cv2.remap(one, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for one in pictures]


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    running = start_server(workers="1", renderer="cpu")
    yield running
    assert stop_server(running) == 0


@pytest.mark.parametrize("rotation", [0, 90])
def test_a_running_server_draws_the_same_pictures(
    tmp_path: Path, grid_file: Path, server: Server, rotation: int
) -> None:
    """With --server nothing is drawn here, and what comes back is what a private service draws."""
    source = made(tmp_path / "in.mp4", rotation=rotation)
    run(source, tmp_path / "here.mp4", "--grid", grid_file, "--crf", 4)
    before = server.metric("unbend_frames_total", result="corrected")
    run(source, tmp_path / "there.mp4", "--grid", grid_file, "--crf", 4, "--server", server.grpc)
    assert server.metric("unbend_frames_total", result="corrected") - before == FRAMES
    here, there = told(tmp_path / "here.mp4"), told(tmp_path / "there.mp4")
    for kept in ("times", "sound", "rotation"):
        assert there[kept] == here[kept]
    assert min(psnr_db(a, b) for a, b in zip(here["pictures"], there["pictures"], strict=True)) > 40


def test_a_server_estimates_and_leaves_alone(tmp_path: Path, server: Server) -> None:
    """The estimate is the server's too; below the confidence that is asked for nothing is touched."""
    source = made(tmp_path / "in.mp4")
    estimates = server.metric("unbend_estimates_total")
    arguments = ("--server", server.grpc, "--min-confidence", 1, "--json")
    summary = json.loads(run(source, tmp_path / "out.mp4", *arguments))
    assert (summary["outcome"], summary["copied"]) == ("left_alone", True)
    assert server.metric("unbend_estimates_total") > estimates
    summary = json.loads(run(source, tmp_path / "sure.mp4", *arguments[:2], "--min-confidence", 0, "--json"))
    assert summary["frames"] == FRAMES


def test_a_server_that_is_not_there_is_a_sentence(tmp_path: Path, grid_file: Path) -> None:
    source = made(tmp_path / "in.mp4")
    message = run(source, tmp_path / "out.mp4", "--grid", grid_file, "--server", "127.0.0.1:9", code=1)
    assert "127.0.0.1:9" in message
    assert not (tmp_path / "out.mp4").exists()


@pytest.fixture
def web(tmp_path: Path) -> Iterator[str]:
    """A web server over tmp_path that knows no ranges: what comes from it cannot be sought in."""
    command = [sys.executable, "-u", "-m", "http.server", "0", "--bind", "127.0.0.1", "--directory", str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as running:
        assert running.stdout is not None
        port = re.search(r"port (\d+)", running.stdout.readline())
        assert port is not None
        yield f"http://127.0.0.1:{port[1]}"
        running.terminate()


def test_a_video_is_read_over_http(tmp_path: Path, grid_file: Path, web: str) -> None:
    """The same frames, times and sound as from the file."""
    source, target = made(tmp_path / "in.mkv"), tmp_path / "out.mkv"
    run(f"{web}/in.mkv", target, "--grid", grid_file, "--crf", 4)
    before, after = told(source), told(target)
    assert after["times"] == before["times"]
    assert [data for _, data in after["sound"]] == [data for _, data in before["sound"]]
    for ours, expected in zip(after["pictures"], drawn(source), strict=True):
        assert psnr_db(ours, expected) > 33


def test_a_left_alone_video_over_http_loses_nothing_that_was_looked_at(tmp_path: Path, web: str) -> None:
    """The packets that the estimate read ahead are in the copy."""
    source, target = made(tmp_path / "in.mkv"), tmp_path / "out.mkv"
    summary = json.loads(run(f"{web}/in.mkv", target, "--min-confidence", 1, "--json"))
    assert (summary["copied"], summary["frames"]) == (True, FRAMES)
    before, after = told(source), told(target)
    np.testing.assert_array_equal(after["pictures"], before["pictures"])
    assert after["sound"] == before["sound"]


def test_an_address_without_a_video_is_a_sentence(tmp_path: Path, grid_file: Path, web: str) -> None:
    message = run(f"{web}/none.mkv", tmp_path / "out.mp4", "--grid", grid_file, code=3)
    assert f"{web}/none.mkv" in message
    assert "404" in message


@pytest.fixture
def camera(tmp_path: Path) -> Iterator[str]:
    """A GStreamer RTSP server that plays four seconds in real time, once for each who asks."""
    if subprocess.run([SYSTEM_PYTHON, "-c", _NEEDED], capture_output=True, check=False).returncode:
        pytest.skip("no RTSP server here (Debian: gir1.2-gst-rtsp-server-1.0 gstreamer1.0-plugins-good python3-gi)")
    source = tmp_path / "camera.mkv"
    picture = f"testsrc2=s={WIDTH}x{HEIGHT}:r=25:d=4"
    made_by = ["ffmpeg", "-v", "error", "-f", "lavfi", "-i", picture, "-f", "lavfi", "-i", "sine=d=4"]
    subprocess.run([*made_by, "-c:v", "libx264", "-bf", "0", "-c:a", "aac", str(source)], check=True, timeout=60)
    with subprocess.Popen([SYSTEM_PYTHON, str(RTSP_SERVER), str(source)], stdout=subprocess.PIPE, text=True) as running:
        assert running.stdout is not None
        yield running.stdout.readline().strip()
        running.terminate()


def test_a_camera_is_read_over_rtsp(tmp_path: Path, grid_file: Path, camera: str) -> None:
    """Four seconds of picture and sound, in step, at the times of the camera."""
    target = tmp_path / "out.mkv"
    summary = json.loads(run(camera, target, "--grid", grid_file, "--json"))
    after = told(target)
    assert summary["frames"] == len(after["times"])
    assert 90 <= len(after["times"]) <= 100
    # the first picture of a camera may come before its clock is known
    np.testing.assert_allclose(np.diff(after["times"])[2:], 0.04, atol=0.002)
    assert len(after["sound"]) > 150
    assert after["sound"][-1][0] == pytest.approx(after["times"][-1], abs=0.2)


def test_it_sits_between_two_ffmpegs(tmp_path: Path, grid_file: Path) -> None:
    """ffmpeg | unbend video - - | ffmpeg: every frame, at its rate, in its colours."""
    source, target = made(tmp_path / "in.mp4"), tmp_path / "out.mp4"
    unbend = f"{shlex.quote(sys.executable)} -m unbend video - - --grid {shlex.quote(str(grid_file))} --workers 1"
    # y4m does not say which matrix its colours have
    said = "-colorspace bt709 -color_primaries bt709 -color_trc bt709"
    pipe = (
        f"ffmpeg -v error -i {source} -f yuv4mpegpipe - | {unbend} | "
        f"ffmpeg -v error -i - -c:v libx264 -crf 4 {said} {target}"
    )
    subprocess.run(["bash", "-eo", "pipefail", "-c", pipe], check=True, timeout=120)
    after = told(target)
    np.testing.assert_allclose(after["times"], [index / 24 for index in range(FRAMES)], atol=1e-3)
    for ours, expected in zip(after["pictures"], drawn(source), strict=True):
        assert psnr_db(ours, expected) > 33
    chroma = {}
    for path in (source, target):
        command = ["ffprobe", "-v", "error", "-of", "json", "-show_entries", "stream=chroma_location", str(path)]
        stream = json.loads(subprocess.run(command, check=True, capture_output=True, timeout=60).stdout)["streams"][0]
        chroma[path] = stream.get("chroma_location", "left")
    assert chroma[target] == chroma[source] == "left"


def test_a_pipe_that_ends_early_leaves_a_file(tmp_path: Path, grid_file: Path) -> None:
    """ffmpeg dies in the middle of a frame: what came whole is there."""
    frame = b"FRAME\n" + bytes(WIDTH * HEIGHT * 3 // 2)
    y4m = f"YUV4MPEG2 W{WIDTH} H{HEIGHT} F24:1 Ip A1:1 C420jpeg\n".encode() + 10 * frame + frame[:500]
    target = tmp_path / "out.mp4"
    command = [sys.executable, "-m", "unbend", "video", "-", str(target), "--grid", str(grid_file), "--workers", "1"]
    subprocess.run(command, input=y4m, timeout=60, check=False, capture_output=True)
    with av.open(str(target)) as container:
        assert len(list(container.decode(video=0))) >= 10


def test_time_is_bounded_where_nobody_answers(tmp_path: Path, grid_file: Path) -> None:
    """A port that nobody listens on is told at once."""
    start = time.monotonic()
    message = run("rtsp://127.0.0.1:9/none", tmp_path / "out.mp4", "--grid", grid_file, code=3)
    assert "rtsp://127.0.0.1:9/none" in message
    assert time.monotonic() - start < 20
