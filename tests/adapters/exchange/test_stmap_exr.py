"""The STMap EXR in another reader's hands, both directions, of a grid that bends."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.adapters.exchange.test_files import DENSE, FILES, GRID, HEIGHT, WIDTH, ours, picture, psnr_db
from tests.fakes import draw_through
from unbend_service.domain.dense_maps import inverse_pixel_maps, pixel_maps
from unbend_service.domain.exchange import DenseMap, ExportFormat
from unbend_service.domain.frames import BLACK, Frame, PixelFormat
from unbend_service.domain.inversion import InverseMap

library = pytest.importorskip("OpenEXR", reason="the extra [export] is not installed")
BACK = DenseMap(*inverse_pixel_maps(GRID, WIDTH, HEIGHT))
PHOTOGRAPH = Path(__file__).parent.parent.parent.parent / "docs/pictures/bent.jpg"


def read_back(dense: DenseMap, folder: Path) -> Any:
    """(height, width, 3) float32: u, v upwards, mask; as OpenEXR's own reader gives them."""
    path = folder / "stmap.exr"
    path.write_bytes(FILES.write_map(ExportFormat.STMAP_EXR, dense).body)
    with library.File(str(path)) as file:
        return file.channels()["RGB"].pixels


def through(stmap: Any, image: np.ndarray, how: int = cv2.INTER_LINEAR) -> np.ndarray:
    """cv2.remap by the numbers of an STMap: u from the left, v from the bottom."""
    height, width = image.shape[:2]
    x, y = stmap[..., 0] * width - np.float32(0.5), stmap[..., 1] * height - np.float32(0.5)
    return cv2.remap(image[::-1], x, y, how, borderMode=cv2.BORDER_REPLICATE)


def test_the_exr_draws_our_picture(tmp_path: Path) -> None:
    """Whoever undistorts by the numbers that OpenEXR reads has the renderer's picture: 40 dB and more."""
    stmap = read_back(DENSE, tmp_path)
    assert (stmap[..., 2] == 1).all(), "a cropped picture has a source everywhere"
    assert psnr_db(picture(), ours()) < 25, "the grid bends"
    assert psnr_db(through(stmap, picture()), ours()) >= 40


def test_the_exr_of_the_way_back_draws_our_redistortion(tmp_path: Path) -> None:
    """Blue says where the straight picture has something to show; masked by it, the picture is ours: 40 dB and more."""
    stmap = read_back(BACK, tmp_path)
    frame = Frame(PixelFormat.RGB24, WIDTH, HEIGHT, picture().reshape(-1))
    expected = draw_through(frame, InverseMap(GRID), BLACK).reshape(HEIGHT, WIDTH, 3)
    assert psnr_db(picture(), expected) < 25
    shown = stmap[..., 2] == 1
    assert 0.5 < shown.mean() < 1, "a crop leaves out the corners of the bent picture"
    drawn = np.where(shown[..., None], through(stmap, picture()), np.uint8(0))
    assert psnr_db(drawn, expected) >= 40


def test_there_and_back_the_photograph_is_what_it_was(tmp_path: Path) -> None:
    """Undistorted and distorted again, every pixel that blue marks is the original's, up to the border: 40 dB."""
    photograph = cv2.imread(str(PHOTOGRAPH))
    assert photograph is not None
    height, width = photograph.shape[:2]
    there = read_back(DenseMap(*pixel_maps(GRID, width, height)), tmp_path)
    back = read_back(DenseMap(*inverse_pixel_maps(GRID, width, height)), tmp_path)
    straight = through(there, photograph, cv2.INTER_CUBIC)
    again = through(back, straight, cv2.INTER_CUBIC)
    shown = back[..., 2] == 1
    assert shown.mean() > 0.5
    assert psnr_db(straight, photograph) < 25
    assert psnr_db(again[shown], photograph[shown]) >= 40
