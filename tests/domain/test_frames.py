from __future__ import annotations

import colorsys

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unbend_service.domain.errors import InvalidFrame, InvalidOption, UnsupportedPixelFormat
from unbend_service.domain.frames import Border, Frame, PixelFormat, frame_size_bytes, planes, split_planes

FORMATS = st.sampled_from(list(PixelFormat))
SIDES = st.integers(1, 40)
COLOURS = st.tuples(*[st.integers(0, 255)] * 3)


@given(FORMATS, SIDES, SIDES)
def test_planes_tile_the_frame(pixel_format: PixelFormat, width: int, height: int) -> None:
    """The planes of a frame follow each other without gap or overlap, and end where the frame ends."""
    offset = 0
    for plane in planes(pixel_format, width, height):
        assert plane.offset == offset
        offset += plane.size_bytes
    assert offset == frame_size_bytes(pixel_format, width, height)


@pytest.mark.parametrize(
    ("pixel_format", "size_bytes"),
    [("gray8", 15), ("rgb24", 45), ("bgr24", 45), ("rgba", 60), ("bgra", 60), ("i420", 15 + 2 * 6), ("nv12", 15 + 12)],
)
def test_odd_frames_round_chroma_up(pixel_format: str, size_bytes: int) -> None:
    """A 5x3 frame has 3x2 chroma samples, as FFmpeg and OpenCV lay it out."""
    assert frame_size_bytes(PixelFormat.parse(pixel_format), 5, 3) == size_bytes


@given(FORMATS, SIDES, SIDES)
def test_plane_arrays_are_views(pixel_format: PixelFormat, width: int, height: int) -> None:
    """Writing to a plane writes to the frame: nothing is copied, and every byte belongs to one plane."""
    data = np.zeros(frame_size_bytes(pixel_format, width, height), np.uint8)
    for view in Frame(pixel_format, width, height, data).plane_arrays():
        assert view.shape[:2] in {(height, width), ((height + 1) // 2, (width + 1) // 2)}
        view += 1
    assert (data == 1).all()
    assert all(view.base is not None for view in split_planes(data, pixel_format, width, height))


def test_read_only_buffers_are_frames() -> None:
    """Bytes from the wire are looked at in place."""
    frame = Frame(PixelFormat.RGB24, 1, 2, np.frombuffer(bytes(range(6)), np.uint8))
    assert frame.plane_arrays()[0][1, 0].tolist() == [3, 4, 5]


@pytest.mark.parametrize(
    ("width", "height", "data"),
    [
        (0, 4, np.zeros(0, np.uint8)),
        (4, -1, np.zeros(0, np.uint8)),
        (2, 2, np.zeros(11, np.uint8)),
        (2, 2, np.zeros(13, np.uint8)),
        (2, 2, np.zeros(12, np.int8)),
        (2, 2, np.zeros((2, 6), np.uint8)),
        (10**9, 10**9, np.zeros(12, np.uint8)),
    ],
)
def test_frames_that_do_not_fit_are_refused(width: int, height: int, data: np.ndarray) -> None:
    """A buffer of another size, type or shape than announced is an InvalidFrame."""
    with pytest.raises(InvalidFrame):
        Frame(PixelFormat.RGB24, width, height, data)


@pytest.mark.parametrize("name", ["yuv444p", "RGB24", "", "i420 "])
def test_unknown_formats_are_refused_with_the_list(name: str) -> None:
    """The answer lists what is known."""
    with pytest.raises(UnsupportedPixelFormat, match="gray8, rgb24, bgr24, rgba, bgra, i420, nv12"):
        PixelFormat.parse(name)


@given(FORMATS, COLOURS, st.integers(0, 255))
def test_a_border_has_a_sample_for_each_channel(
    pixel_format: PixelFormat, colour: tuple[int, int, int], alpha: int
) -> None:
    """One tuple per plane, one 8-bit number per channel."""
    samples = Border(*colour, alpha).samples(pixel_format)
    for plane, values in zip(planes(pixel_format, 4, 4), samples, strict=True):
        assert len(values) == plane.channels
        assert all(0 <= value <= 255 for value in values)


@given(COLOURS)
def test_border_colours_survive_yuv(colour: tuple[int, int, int]) -> None:
    """Read by OpenCV as video range BT.601, the border has the colour that was asked for, within rounding."""
    (luma,), (u,), (v,) = Border(*colour).samples(PixelFormat.I420)
    assert Border(*colour).samples(PixelFormat.NV12) == ((luma,), (u, v))
    frame = np.array([luma] * 4 + [u, v], np.uint8).reshape(3, 2)
    seen = cv2.cvtColor(frame, cv2.COLOR_YUV2RGB_I420)[0, 0]
    assert np.abs(seen.astype(int) - colour).max() <= 3


def test_neutral_borders_have_neutral_chroma() -> None:
    """Black, grey and white are 16..235 with 128 for both colour differences."""
    for level, luma in ((0, 16), (128, 126), (255, 235)):
        assert Border(level, level, level).samples(PixelFormat.I420) == ((luma,), (128,), (128,))


@given(COLOURS)
def test_border_colours_survive_the_planes_of_a_jpeg(colour: tuple[int, int, int]) -> None:
    """Read by OpenCV as full range BT.601, the border has the colour that was asked for, within rounding."""
    (luma,), (blue,), (red,) = Border(*colour).samples(PixelFormat.YUVJ420P)
    seen = cv2.cvtColor(np.array([[[luma, red, blue]]], np.uint8), cv2.COLOR_YCrCb2RGB)[0, 0]
    assert np.abs(seen.astype(int) - colour).max() <= 2


def test_packed_borders_follow_their_channel_order() -> None:
    """Red first or blue first, alpha last, grey as perceived."""
    border = Border(10, 20, 30, 40)
    assert border.samples(PixelFormat.RGB24) == ((10, 20, 30),)
    assert border.samples(PixelFormat.BGR24) == ((30, 20, 10),)
    assert border.samples(PixelFormat.RGBA) == ((10, 20, 30, 40),)
    assert border.samples(PixelFormat.BGRA) == ((30, 20, 10, 40),)
    assert border.samples(PixelFormat.GRAY8) == ((round(255 * colorsys.rgb_to_yiq(10 / 255, 20 / 255, 30 / 255)[0]),),)


@pytest.mark.parametrize("channel", ["red", "green", "blue", "alpha"])
@pytest.mark.parametrize("value", [-1, 256])
def test_border_colours_out_of_range_are_refused(channel: str, value: int) -> None:
    """No number wraps round silently."""
    with pytest.raises(InvalidOption, match=r"0\.\.255"):
        Border(**{channel: value})
