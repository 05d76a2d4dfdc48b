"""The programs in client/examples, run as they stand."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from tests.acceptance.conftest import Server

EXAMPLES = Path(__file__).parent.parent.parent / "client/examples"
WIDTH, HEIGHT, FRAMES = 320, 240, 12


def draw(index: int) -> np.ndarray:
    """(HEIGHT, WIDTH, 3) RGB: a wall of tiles, bent outwards, with a mark that moves."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
    u, v = 2 * x / WIDTH - 1, 2 * y / HEIGHT - 1
    bend = 1 - 0.15 * (u * u + v * v)
    tiles = ((np.floor(u / bend * 8) + np.floor(v / bend * 6)) % 2 * 120 + 60).astype(np.uint8)
    image = cv2.cvtColor(tiles, cv2.COLOR_GRAY2RGB)
    return cv2.circle(image, (20 + 20 * index, 120), 8, (255, 0, 0), -1)


@pytest.fixture
def film(tmp_path: Path) -> Path:
    path = tmp_path / "film.mkv"
    with av.open(str(path), "w") as out:
        track = out.add_stream("libx264", rate=25)
        track.width, track.height, track.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for index in range(FRAMES):
            out.mux(track.encode(av.VideoFrame.from_ndarray(draw(index), format="rgb24")))
        out.mux(track.encode(None))
    return path


def run(name: str, *arguments: str, **options: object) -> subprocess.CompletedProcess[bytes]:
    command = [sys.executable, str(EXAMPLES / name), *arguments]
    return subprocess.run(command, capture_output=True, timeout=120, check=False, **options)


@pytest.mark.parametrize("name", sorted(path.name for path in EXAMPLES.glob("*.py")))
def test_every_example_says_how_it_is_used(name: str) -> None:
    result = run(name, "--help")

    assert result.returncode == 0, result.stderr
    assert f"python {name}".encode() in result.stdout
    assert b"--target" in result.stdout


def test_a_camera_is_straightened_into_a_file_with_its_times(server: Server, film: Path, tmp_path: Path) -> None:
    out = tmp_path / "straight.mkv"

    result = run("camera.py", film.as_uri(), "--out", str(out), "--target", server.grpc)

    assert result.returncode == 0, result.stderr
    with av.open(str(out)) as written:
        frames = list(written.decode(video=0))
    assert [round(frame.time * 25) for frame in frames] == list(range(FRAMES))
    assert (frames[0].width, frames[0].height) == (WIDTH, HEIGHT)


def test_a_camera_may_be_watched_without_falling_behind(server: Server, film: Path) -> None:
    result = run("camera.py", film.as_uri(), "--latest", "--frames", "5", "--target", server.grpc)

    assert result.returncode == 0, result.stderr
    shown = re.match(rb"(\d+) frames", result.stderr)
    assert shown is not None
    assert 1 <= int(shown[1]) <= 5


def test_a_folder_is_straightened_once_and_a_bad_file_does_not_stop_it(server: Server, tmp_path: Path) -> None:
    folder, out = tmp_path / "in", tmp_path / "out"
    folder.mkdir()
    for index in range(3):
        cv2.imwrite(str(folder / f"{index}.png"), draw(index))
    (folder / "broken.jpg").write_bytes(b"no picture")
    (folder / "notes.txt").write_text("not for us")

    first = run("folder.py", str(folder), str(out), "--target", server.grpc)
    second = run("folder.py", str(folder), str(out), "--target", server.grpc)

    assert first.returncode == 1
    assert b"broken.jpg" in first.stderr
    assert sorted(path.name for path in out.iterdir()) == ["0.png", "1.png", "2.png"]
    assert cv2.imread(str(out / "0.png")).shape == (HEIGHT, WIDTH, 3)
    assert b"3 skipped" in second.stdout


def test_raw_frames_go_through_a_pipe(server: Server) -> None:
    frames = b"".join(cv2.cvtColor(draw(i), cv2.COLOR_RGB2YUV_I420).tobytes() for i in range(FRAMES))

    result = run("ffmpeg_pipe.py", str(WIDTH), str(HEIGHT), "--target", server.grpc, input=frames)

    assert result.returncode == 0, result.stderr
    assert len(result.stdout) == len(frames)
    torn = run("ffmpeg_pipe.py", str(WIDTH), str(HEIGHT), "--target", server.grpc, input=frames[:-1])
    assert torn.returncode == 1
    assert b"ended within a frame" in torn.stderr


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="there is no ffmpeg here")
def test_the_pipe_stands_between_two_ffmpegs(server: Server, film: Path, tmp_path: Path) -> None:
    size, raw = f"{WIDTH} {HEIGHT}", "-f rawvideo -pix_fmt yuv420p"
    line = (
        f"ffmpeg -v error -i {film} {raw} - | {sys.executable} {EXAMPLES}/ffmpeg_pipe.py {size} --target {server.grpc}"
        f" | ffmpeg -v error {raw} -s {WIDTH}x{HEIGHT} -r 25 -i - straight.mkv"
    )

    subprocess.run(["bash", "-euo", "pipefail", "-c", line], cwd=tmp_path, check=True, timeout=120)

    with av.open(str(tmp_path / "straight.mkv")) as written:
        assert len(list(written.decode(video=0))) == FRAMES


@pytest.fixture
def proxy(server: Server) -> Iterator[str]:
    command = [sys.executable, str(EXAMPLES / "upload_proxy.py"), "--port", "0", "--target", server.grpc]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if found := re.search(r"running on (http://\S+)", line):
                yield found[1]
                break
        process.terminate()
        process.stderr.read()


def test_an_upload_comes_out_straight_and_a_bad_one_is_the_senders_to_mend(proxy: str) -> None:
    body = cv2.imencode(".png", draw(0))[1].tobytes()

    with urllib.request.urlopen(urllib.request.Request(f"{proxy}/photos", body), timeout=60) as answer:
        assert answer.headers["X-Straightened"] in ("corrected", "left_alone")
        picture = cv2.imdecode(np.frombuffer(answer.read(), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (HEIGHT, WIDTH, 3)
    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(urllib.request.Request(f"{proxy}/photos", b"no picture"), timeout=60)
    assert refused.value.code == 422
    refused.value.close()
