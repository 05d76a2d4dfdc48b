from __future__ import annotations

import cv2
import numpy as np
import pytest

from unbend_service.application.grey import grey_of_frame
from unbend_service.domain.frames import Frame, PixelFormat, frame_size_bytes


def frame_of(pixel_format: PixelFormat, bgr: np.ndarray) -> Frame:
    codes = {
        PixelFormat.GRAY8: cv2.COLOR_BGR2GRAY,
        PixelFormat.RGB24: cv2.COLOR_BGR2RGB,
        PixelFormat.RGBA: cv2.COLOR_BGR2RGBA,
        PixelFormat.BGRA: cv2.COLOR_BGR2BGRA,
    }
    packed = bgr if pixel_format is PixelFormat.BGR24 else cv2.cvtColor(bgr, codes[pixel_format])
    return Frame(pixel_format, bgr.shape[1], bgr.shape[0], packed.ravel())


@pytest.mark.parametrize("name", ["gray8", "rgb24", "bgr24", "rgba", "bgra"])
def test_every_packed_format_gives_the_same_luma(name: str) -> None:
    bgr = np.random.default_rng(0).integers(0, 255, (30, 40, 3), dtype=np.uint8)
    grey = grey_of_frame(frame_of(PixelFormat(name), bgr), 1024)
    assert np.abs(grey.astype(int) - cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY)).max() <= 1


@pytest.mark.parametrize("name", ["i420", "nv12"])
def test_planar_formats_give_their_luma_plane(name: str) -> None:
    pixel_format = PixelFormat(name)
    data = np.arange(frame_size_bytes(pixel_format, 7, 5), dtype=np.uint8)
    assert (grey_of_frame(Frame(pixel_format, 7, 5, data), 1024) == data[:35].reshape(5, 7)).all()


def test_a_large_frame_is_reduced_by_whole_areas_but_not_below_what_was_asked() -> None:
    data = np.random.default_rng(0).integers(0, 255, 1080 * 1920, dtype=np.uint8)
    grey = grey_of_frame(Frame(PixelFormat.GRAY8, 1920, 1080, data), 640)
    expected = cv2.resize(data.reshape(1080, 1920), (640, 360), interpolation=cv2.INTER_AREA)
    assert grey.shape == (360, 640)
    assert np.abs(grey.astype(int) - expected).max() <= 1


@pytest.mark.parametrize(("width", "height"), [(1, 5000), (5000, 1), (1, 1)])
def test_frames_thinner_than_the_reduction_still_give_a_picture(width: int, height: int) -> None:
    grey = grey_of_frame(Frame(PixelFormat.GRAY8, width, height, np.full(width * height, 9, np.uint8)), 256)
    assert min(grey.shape) >= 1
    assert (grey == 9).all()
