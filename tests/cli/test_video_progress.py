"""What a person sees of ``unbend video`` while it runs, on a real terminal."""

from __future__ import annotations

import os
import pty
import re
import select
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.cli.videos import made

_ESCAPES = re.compile(rb"\x1b\[[0-9;?]*[A-Za-z]")


def on_terminal(*arguments: object) -> tuple[int, str]:
    """Runs the command on a terminal of its own.

    Returns:
        Exit code, and what was shown without its escape sequences.
    """
    master, slave = pty.openpty()
    environment = os.environ | {"COLUMNS": "100", "TERM": "xterm", "UNBEND_RENDERER": "cpu"}
    command = [sys.executable, "-m", "unbend", "video", *map(str, arguments), "--workers", "1"]
    process = subprocess.Popen(
        command,
        stdin=slave,
        stdout=slave,
        stderr=slave,
        env=environment,
        start_new_session=True,
    )
    os.close(slave)
    seen, deadline = b"", time.monotonic() + 90
    while time.monotonic() < deadline:
        ready, _, _ = select.select([master], [], [], 0.2)
        if ready:
            try:
                part = os.read(master, 65536)
            except OSError:
                break
            if not part:
                break
            seen += part
        elif process.poll() is not None:
            break
    os.close(master)
    code = process.wait(30)
    return code, _ESCAPES.sub(b"", seen).decode()


@pytest.fixture
def film(tmp_path: Path) -> Path:
    """Six seconds, slow enough to be watched."""
    path = tmp_path / "film.mp4"
    picture = "testsrc2=s=1280x720:r=30:d=6"
    command = ["ffmpeg", "-v", "error", "-f", "lavfi", "-i", picture, "-preset", "ultrafast", str(path)]
    subprocess.run(command, check=True, timeout=60)
    return path


def test_the_bar_shows_frames_speed_and_the_time_left(film: Path, tmp_path: Path, grid_file: Path) -> None:
    """How many of how many, frames a second that are not nothing, minutes and seconds; and one line at the end."""
    code, seen = on_terminal(film, tmp_path / "out.mp4", "--grid", grid_file, "--preset", "ultrafast")
    assert code == 0, seen
    shown = [
        (int(done), float(fps), left)
        for done, fps, left in re.findall(r"(\d+)/180 frames .*? ([\d.]+) fps (\S+)", seen)
    ]
    done = [one[0] for one in shown]
    assert len(set(done)) > 3, seen
    assert done == sorted(done)
    assert any(fps > 1 for _, fps, _ in shown)
    assert any(re.fullmatch(r"0:00:\d\d", left) for _, _, left in shown)
    assert "180 frames at" in seen.splitlines()[-1]


def test_a_bar_is_no_part_of_a_log(tmp_path: Path, grid_file: Path) -> None:
    """Where standard error is a file there is one line, and with --quiet no bar on a terminal either."""
    source = made(tmp_path / "in.mp4")
    command = [sys.executable, "-m", "unbend", "video", str(source), "--grid", str(grid_file), "--workers", "1"]
    done = subprocess.run([*command, str(tmp_path / "one.mp4")], capture_output=True, text=True, timeout=60, check=True)
    assert len(done.stderr.splitlines()) == 1
    code, seen = on_terminal(source, tmp_path / "two.mp4", "--grid", grid_file, "--quiet")
    assert code == 0
    assert "fps" not in seen
