from __future__ import annotations

import itertools
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.domain.lenses import BARREL, radial
from tests.fakes import draw_through
from unbend_service.domain.fit import CROP, with_fit
from unbend_service.domain.frames import BLACK, Frame, PixelFormat
from unbend_service.domain.grid import Grid
from unbend_service.domain.orientation import Orientation

WIDTH, HEIGHT = 96, 64
SIGNS = list(itertools.product((1, -1), repeat=2))
ALL = [(x, 0, 0, y) for x, y in SIGNS] + [(0, x, y, 0) for x, y in SIGNS]
#: A lens that is off its centre, so that no two orientations of it are the same.
GRID = with_fit(Grid.from_map(lambda target: radial(BARREL)(target - 0.1) + 0.1, 33, 41), CROP)


def frame(width: int = WIDTH, height: int = HEIGHT, pixel_format: PixelFormat = PixelFormat.I420) -> Frame:
    """Smooth, and different in each corner."""
    random = np.random.default_rng(5)
    noise = cv2.GaussianBlur(random.normal(size=(height * 3, width * 3)), (0, 0), 3)[:height, :width] * 600
    slope = np.linspace(0, 90, width)[None] + np.linspace(0, 60, height)[:, None]
    luma = np.clip(60 + slope + noise, 0, 255).astype(np.uint8)
    if pixel_format is PixelFormat.GRAY8:
        return Frame(pixel_format, width, height, luma.reshape(-1))
    small = cv2.resize(luma, ((width + 1) // 2, (height + 1) // 2)).reshape(-1)
    return Frame(pixel_format, width, height, np.concatenate([luma.reshape(-1), small, 255 - small]))


@pytest.mark.parametrize("matrix", ALL, ids=str)
def test_a_turned_grid_does_to_the_stored_picture_what_the_grid_does_to_the_shown_one(
    matrix: tuple[int, int, int, int],
) -> None:
    """Correct and then show, or show and then correct: the same picture."""
    orientation = Orientation(matrix)
    stored = frame(pixel_format=PixelFormat.GRAY8)
    one = orientation.shown(
        Frame(stored.pixel_format, WIDTH, HEIGHT, draw_through(stored, orientation.stored(GRID), BLACK))
    )
    shown = orientation.shown(stored)
    other = draw_through(shown, GRID, BLACK)
    assert np.abs(one.data.astype(int) - other).mean() < 0.05
    assert np.abs(shown.data.astype(int) - other).mean() > 2


@pytest.mark.parametrize("matrix", ALL, ids=str)
def test_every_plane_is_turned(matrix: tuple[int, int, int, int]) -> None:
    """The corner of the stored picture lies where the matrix puts it, in luma and chroma, for odd sizes too."""
    orientation = Orientation(matrix)
    for width, height in ((WIDTH, HEIGHT), (31, 17)):
        stored = frame(width, height)
        shown = orientation.shown(stored)
        assert (shown.width, shown.height) == ((height, width) if orientation.swaps_axes else (width, height))
        for before, after in zip(stored.plane_arrays(), shown.plane_arrays(), strict=True):
            xx, xy, yx, yy = matrix
            column, row = (0 if xx + xy > 0 else -1), (0 if yx + yy > 0 else -1)
            assert after[row, column] == before[0, 0]
            assert sorted(after.reshape(-1)) == sorted(before.reshape(-1))


def test_a_turn_by_less_than_a_quarter_is_none() -> None:
    """A matrix that tilts or scales is left to the player."""
    assert Orientation.of_display_matrix([46341, 46341, 0, -46341, 46341, 0, 0, 0, 1 << 30]).is_upright
    assert Orientation.of_display_matrix([0] * 9).is_upright
    assert Orientation.of_display_matrix([65536, 0, 0, 0, 65536, 0, 0, 0, 1 << 30]).is_upright


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="ffmpeg is not installed")
@pytest.mark.parametrize(("degrees", "hflip", "vflip"), [(90, 0, 0), (180, 0, 0), (-90, 0, 0), (0, 1, 0), (90, 0, 1)])
def test_a_picture_is_turned_as_ffmpeg_turns_it(tmp_path: Path, degrees: int, hflip: int, vflip: int) -> None:
    """What a player shows of a telephone's video is what the estimator is shown."""
    av = pytest.importorskip("av", reason="the extra [video] is not installed")
    stored, path = frame(), tmp_path / "turned.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=10, options={"crf": "0"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.set_display_rotation(degrees, hflip=bool(hflip), vflip=bool(vflip))
        array = stored.data.reshape(HEIGHT * 3 // 2, WIDTH)
        container.mux(stream.encode(av.VideoFrame.from_ndarray(array, format="yuv420p")))
        container.mux(stream.encode(None))
    with av.open(str(path)) as container:
        matrix = next(container.decode(video=0)).side_data["DISPLAYMATRIX"]
    shown = Orientation.of_display_matrix(np.frombuffer(matrix, "=i4").tolist()).shown(stored)
    command = ["ffmpeg", "-v", "error", "-i", str(path), "-f", "rawvideo", "-pix_fmt", "yuv420p", "-"]
    players = np.frombuffer(subprocess.run(command, check=True, capture_output=True, timeout=60).stdout, np.uint8)
    luma = shown.width * shown.height
    np.testing.assert_array_equal(shown.data[:luma], players[:luma])
