from __future__ import annotations

import re

import numpy as np
import pytest

from unbend_service.domain.errors import InvalidFrame, InvalidOption
from unbend_service.domain.frames import (
    BLACK,
    BORDER_PATTERN,
    TRANSPARENT,
    Border,
    Frame,
    PixelFormat,
    frame_size_bytes,
    with_alpha,
)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("black", BLACK),
        ("White", Border(255, 255, 255)),
        ("transparent", TRANSPARENT),
        ("ff8000", Border(255, 128, 0)),
        ("#FF8000", Border(255, 128, 0)),
        ("ff800080", Border(255, 128, 0, 128)),
    ],
)
def test_borders_are_read(text: str, expected: Border) -> None:
    """A border is a name or a colour in hex."""
    assert Border.parse(text) == expected


@pytest.mark.parametrize("text", ["", "mauve", "#12", "12345", "gggggg", "##ff8000", "ff8000 "])
def test_other_borders_are_refused(text: str) -> None:
    """Anything else is answered with what would have been accepted."""
    with pytest.raises(InvalidOption, match="transparent"):
        Border.parse(text)


@pytest.mark.parametrize(
    ("pixel_format", "expected", "first"),
    [
        (PixelFormat.GRAY8, PixelFormat.RGBA, [0, 0, 0, 255]),
        (PixelFormat.RGB24, PixelFormat.RGBA, [0, 1, 2, 255]),
        (PixelFormat.BGR24, PixelFormat.BGRA, [0, 1, 2, 255]),
        (PixelFormat.RGBA, PixelFormat.RGBA, [0, 1, 2, 3]),
    ],
)
def test_alpha_is_added_opaque(pixel_format: PixelFormat, expected: PixelFormat, first: list[int]) -> None:
    """Packed frames gain an opaque alpha channel and keep their colours in order."""
    size = frame_size_bytes(pixel_format, 4, 2)
    frame = with_alpha(Frame(pixel_format, 4, 2, np.arange(size, dtype=np.uint8)))
    assert frame.pixel_format is expected
    assert frame.data[:4].tolist() == first


def test_planar_frames_have_no_alpha() -> None:
    """i420 and nv12 have no room for it."""
    with pytest.raises(InvalidFrame):
        with_alpha(Frame(PixelFormat.I420, 2, 2, np.zeros(6, np.uint8)))


@pytest.mark.parametrize(
    "text",
    [
        "black",
        "White",
        "tranSparent",
        "ff8000",
        "#FF8000",
        "ff800080",
        "",
        "whitf",
        "ff80",
        "#ff800",
        "xblack",
        "##ff8000",
    ],
)
def test_the_pattern_of_the_documentation_says_what_is_read(text: str) -> None:
    """Whoever goes by it is never refused, and is told of all that is taken."""
    try:
        Border.parse(text)
    except InvalidOption:
        assert not re.search(BORDER_PATTERN, text)
    else:
        assert re.search(BORDER_PATTERN, text)
