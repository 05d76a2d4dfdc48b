"""What of a video stays as it is: subtitles, chapters, orientation, colours; all of it where nothing is to be done."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.cli.videos import FRAMES, HEIGHT, WIDTH, av, made, psnr_db, run, told

ROOT = Path(__file__).parent.parent.parent
BENT = ROOT / "service/unbend_service/web/samples/shopfront.jpg"
SUBTITLES = "1\n00:00:00,100 --> 00:00:00,500\nStraight ahead\n\n2\n00:00:00,600 --> 00:00:00,900\n<i>and</i> home\n"
CHAPTERS = "[CHAPTER]\nTIMEBASE=1/1000\nSTART={}\nEND={}\ntitle={}\n"

pytestmark = pytest.mark.usefixtures("cpu_renderer")


def ffmpeg(*arguments: object) -> None:
    subprocess.run(["ffmpeg", "-v", "error", "-y", *map(str, arguments)], check=True, timeout=60)


def probed(path: Path) -> dict[str, Any]:
    command = ["ffprobe", "-v", "error", "-of", "json", "-show_streams", "-show_chapters", "-show_format", str(path)]
    return dict(json.loads(subprocess.run(command, check=True, capture_output=True, timeout=60).stdout))


def packets(path: Path, kind: str) -> list[tuple[float, bytes]]:
    """When and what, of the first stream of a kind."""
    with av.open(str(path)) as container:
        stream = next(stream for stream in container.streams if stream.type == kind)
        found = [packet for packet in container.demux(stream) if packet.size]
        return [(round(float(packet.pts * packet.time_base), 3), bytes(packet)) for packet in found]


@pytest.mark.parametrize(("suffix", "codec"), [(".mkv", "subrip"), (".mp4", "mov_text")])
def test_subtitles_and_chapters_are_copied(tmp_path: Path, grid_file: Path, suffix: str, codec: str) -> None:
    """Text, times, language and whether it is shown by default; chapters with their titles."""
    (tmp_path / "text.srt").write_text(SUBTITLES)
    (tmp_path / "chapters.txt").write_text(
        ";FFMETADATA1\n" + CHAPTERS.format(0, 500, "Out") + CHAPTERS.format(500, 1000, "Home")
    )
    source, target = tmp_path / f"in{suffix}", tmp_path / f"out{suffix}"
    inputs = ["-i", made(tmp_path / "plain.mp4"), "-i", tmp_path / "text.srt", "-i", tmp_path / "chapters.txt"]
    kept = ["-map", 0, "-map", 1, "-map_chapters", 2, "-c", "copy", "-c:s", codec]
    ffmpeg(*inputs, *kept, "-metadata:s:s:0", "language=fin", "-disposition:s:0", "forced", source)
    run(source, target, "--grid", grid_file)
    before, after = probed(source), probed(target)
    # mp4 holds the titles of chapters in a stream of its own
    assert [one["codec_type"] for one in after["streams"]][:3] == ["video", "audio", "subtitle"]
    old, new = before["streams"][2], after["streams"][2]
    assert old["codec_name"] == new["codec_name"] == codec
    assert new["tags"]["language"] == "fin"
    assert new["disposition"]["forced"] == old["disposition"]["forced"] == 1
    assert packets(target, "subtitle") == packets(source, "subtitle")
    assert any(b"Straight ahead" in data for _, data in packets(target, "subtitle"))
    for name in ("start_time", "end_time", "tags"):
        assert [one[name] for one in after["chapters"]] == [one[name] for one in before["chapters"]]


def test_colours_keep_their_range_and_matrix(tmp_path: Path, grid_file: Path) -> None:
    """Full range BT.601 with other primaries stays what it is, in what the file says and in the samples."""
    source, target = tmp_path / "in.mp4", tmp_path / "out.mp4"
    said = ["-color_range", "pc", "-colorspace", "smpte170m", "-color_primaries", "bt470bg", "-color_trc", "smpte170m"]
    grey = f"color=0x050505:s={WIDTH}x{HEIGHT}:r=24:d=1,format=yuvj420p"
    ffmpeg("-f", "lavfi", "-i", grey, "-c:v", "libx264", "-crf", 1, *said, source)
    run(source, target, "--grid", grid_file, "--crf", 1)
    names = ("color_range", "color_space", "color_primaries", "color_transfer", "pix_fmt", "sample_aspect_ratio")
    before, after = (probed(path)["streams"][0] for path in (source, target))
    for name in names[:4]:
        assert after[name] == before[name], name
    assert after["color_range"] == "pc"
    with av.open(str(target)) as container:
        luma = next(container.decode(video=0)).to_ndarray(format="gray")[HEIGHT // 2, WIDTH // 2]
    assert luma == pytest.approx(5, abs=2)


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".ts"])
def test_a_video_that_is_left_alone_is_copied(tmp_path: Path, suffix: str) -> None:
    """Not sure enough: every packet of picture and sound is the same byte for byte, and the summary says so."""
    source, target = made(tmp_path / "in.mp4", rotation=90), tmp_path / f"out{suffix}"
    summary = json.loads(run(source, target, "--min-confidence", 1, "--json"))
    assert (summary["outcome"], summary["copied"], summary["frames"]) == ("left_alone", True, FRAMES)
    before, after = told(source), told(target)
    for ours, original in zip(after["pictures"], before["pictures"], strict=True):
        np.testing.assert_array_equal(ours, original)
    moved = after["times"][0] - before["times"][0]
    np.testing.assert_allclose(np.array(after["times"]) - moved, before["times"], atol=2e-3)
    assert after["sound"][0][0] - before["sound"][0][0] == pytest.approx(moved, abs=2e-3)
    header = 7 if suffix == ".ts" else 0  # each frame of sound has its ADTS header there
    assert [data[header:] for _, data in after["sound"]] == [data for _, data in before["sound"]]
    if suffix != ".ts":  # which holds no orientation, and repeats the encoder's parameters in its packets
        assert after["rotation"] == before["rotation"]
        assert [data for _, data in packets(target, "video")] == [data for _, data in packets(source, "video")]


@pytest.mark.parametrize(
    ("arguments", "suffix", "codec"),
    [
        (("--codec", "hevc", "--preset", "ultrafast"), ".mp4", "hevc"),
        (("--crf", "30"), ".mp4", "h264"),
        ((), ".webm", "vp9"),
    ],
)
def test_a_video_that_is_left_alone_is_encoded_where_that_is_asked_for(
    tmp_path: Path, arguments: tuple[str, ...], suffix: str, codec: str
) -> None:
    """Another codec or quality, or a container that does not hold the old one."""
    source, target = made(tmp_path / "in.mp4"), tmp_path / f"out{suffix}"
    summary = json.loads(run(source, target, "--min-confidence", 1, "--json", *arguments))
    assert (summary["outcome"], summary["copied"], summary["frames"]) == ("left_alone", False, FRAMES)
    after = told(target)
    assert after["codec"] == codec
    assert psnr_db(after["pictures"][3], told(source)["pictures"][3]) > 25


def bent(path: Path, rotation: int) -> Path:
    """Six frames of a bent shop front without loss, stored lying and turned by a flag if ``rotation`` is not 0."""
    picture = cv2.cvtColor(cv2.resize(cv2.imread(str(BENT)), (960, 640)), cv2.COLOR_BGR2RGB)
    upright = av.VideoFrame.from_ndarray(picture, format="rgb24").reformat(format="yuv420p").to_ndarray()
    planes = [upright[:640], upright[640:800].reshape(320, 480), upright[800:].reshape(320, 480)]
    stored = [np.rot90(plane, -rotation // 90) for plane in planes]
    height, width = stored[0].shape
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=24, options={"crf": "0", "preset": "ultrafast"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        if rotation:
            stream.set_display_rotation(rotation)
        array = np.concatenate([np.ascontiguousarray(plane).reshape(-1) for plane in stored]).reshape(-1, width)
        for _ in range(6):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(array, format="yuv420p")))
        container.mux(stream.encode(None))
    return path


def shown(path: Path, into: Path) -> np.ndarray:
    """The fourth picture as a player shows it."""
    ffmpeg("-i", path, "-vf", r"select=eq(n\,3)", "-frames:v", 1, into)
    picture = cv2.imread(str(into))
    assert picture is not None
    return picture


@pytest.mark.parametrize("rotation", [90, 180])
def test_a_telephones_video_is_estimated_as_it_is_shown(tmp_path: Path, rotation: int) -> None:
    """However it is stored, the grid is that of the upright video, the result looks the same, and the flag stays."""
    level, turned = bent(tmp_path / "level.mp4", 0), bent(tmp_path / "turned.mp4", rotation)
    summaries = []
    for source in (level, turned):
        out = tmp_path / f"out-{source.name}"
        summaries.append(json.loads(run(source, out, "--json", "--crf", 4)))
    assert summaries[0]["outcome"] == "corrected"
    assert summaries[0]["grid_id"] == summaries[1]["grid_id"]
    first, second = (shown(tmp_path / f"out-{path.name}", tmp_path / f"{path.stem}.png") for path in (level, turned))
    assert first.shape == second.shape
    assert psnr_db(first, second) > 38
    assert psnr_db(first, shown(level, tmp_path / "source.png")) < 25
    with av.open(str(tmp_path / "out-turned.mp4")) as container:
        assert next(container.decode(video=0)).rotation == rotation or abs(rotation) == 180


def test_pixels_that_are_not_square_are_estimated_as_they_are_shown(tmp_path: Path) -> None:
    """Squeezed to three quarters of its width for the file, a video gets about the grid of the unsqueezed one."""
    plain, squeezed = bent(tmp_path / "plain.mp4", 0), tmp_path / "squeezed.mp4"
    ffmpeg("-i", plain, "-vf", "scale=720:640:flags=area,setsar=4/3", "-c:v", "libx264", "-crf", 4, squeezed)
    drawn = []
    for source in (plain, squeezed):
        summary = json.loads(run(source, source.with_suffix(".mkv"), "--json", "--crf", 4))
        assert summary["outcome"] == "corrected"
        picture = shown(source.with_suffix(".mkv"), tmp_path / f"{source.stem}.png")
        drawn.append(cv2.resize(picture, (480, 320), interpolation=cv2.INTER_AREA))
    assert psnr_db(*drawn) > 28
    assert psnr_db(drawn[1], cv2.resize(shown(plain, tmp_path / "source.png"), (480, 320))) < 22
    assert probed(squeezed.with_suffix(".mkv"))["streams"][0]["sample_aspect_ratio"] == "4:3"
