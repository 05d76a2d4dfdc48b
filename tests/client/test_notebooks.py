"""What a notebook shows of a correction."""

from __future__ import annotations

import base64
import re

import cv2
import numpy as np
import pytest

import unbend
from unbend._colours import read_rgb
from unbend._notebooks import encode_png, shrink


def shown(correction: unbend.Correction) -> list[np.ndarray]:
    """(height, width, 3) RGB of every picture in the representation."""
    bodies = re.findall(r'src="data:image/\w+;base64,([^"]+)"', correction._repr_html_())
    return [
        cv2.imdecode(np.frombuffer(base64.b64decode(body), np.uint8), cv2.IMREAD_COLOR)[..., ::-1] for body in bodies
    ]


def test_a_png_holds_every_pixel() -> None:
    image = np.random.default_rng(1).integers(0, 255, (7, 5, 3), dtype=np.uint8)

    read = cv2.imdecode(np.frombuffer(encode_png(image), np.uint8), cv2.IMREAD_COLOR)

    assert np.array_equal(read[..., ::-1], image)


def test_a_large_picture_is_shown_smaller_and_a_small_one_as_it_is() -> None:
    ramp = np.broadcast_to(np.arange(0, 200, 0.1)[None, :, None], (300, 2000, 3)).astype(np.uint8)

    assert shrink(ramp).shape == (100, 666, 3)
    assert abs(shrink(ramp).astype(float).mean() - ramp.mean()) < 1
    assert shrink(ramp[:, :700]) is not None
    assert np.array_equal(shrink(ramp[:, :700]), ramp[:, :700])


def test_before_and_after_are_shown_with_the_outcome(client: unbend.Client, picture: np.ndarray) -> None:
    correction = client.correct(picture)

    before, after = shown(correction)

    assert np.array_equal(before, picture)
    assert np.array_equal(after, correction.image)
    assert "corrected" in correction._repr_html_()
    assert correction.grid_id in correction._repr_html_()


def test_what_was_sent_is_shown_even_if_its_array_was_used_again(client: unbend.Client, picture: np.ndarray) -> None:
    sent = picture.copy()
    correction = client.correct(sent)
    sent[:] = 0

    assert np.array_equal(shown(correction)[0], picture)


def test_a_picture_that_was_left_alone_says_why(client: unbend.Client, picture: np.ndarray) -> None:
    correction = client.correct(picture, min_confidence=0.95)

    assert "left alone (low confidence)" in correction._repr_html_()


@pytest.mark.parametrize("extension", [".jpg", ".png", ".webp"])
def test_files_are_shown_as_they_are(client: unbend.Client, picture: np.ndarray, extension: str) -> None:
    assert [image.shape for image in shown(client.correct(cv2.imencode(extension, picture)[1].tobytes()))] == [
        picture.shape,
        picture.shape,
    ]


def test_a_file_that_browsers_do_not_show_is_left_out(client: unbend.Client, picture: np.ndarray) -> None:
    correction = client.correct(cv2.imencode(".tiff", picture)[1].tobytes(), answer_format="png")

    assert len(shown(correction)) == 1


CODES = {
    "gray8": cv2.COLOR_RGB2GRAY,
    "bgr24": cv2.COLOR_RGB2BGR,
    "rgba": cv2.COLOR_RGB2RGBA,
    "bgra": cv2.COLOR_RGB2BGRA,
    "i420": cv2.COLOR_RGB2YUV_I420,
}


@pytest.mark.parametrize("name", CODES)
def test_colours_of_every_raw_format_are_those_of_the_picture(client: unbend.Client, name: str) -> None:
    picture = np.full((48, 64, 3), (200, 100, 50), np.uint8)
    frame = cv2.cvtColor(picture, CODES[name])

    before, _ = shown(client.correct(frame, pixel_format=name))

    expected = cv2.cvtColor(cv2.cvtColor(picture, CODES[name]), cv2.COLOR_GRAY2RGB) if name == "gray8" else picture
    assert np.abs(before.astype(int) - expected.astype(int)).max() <= 3


def test_nv12_and_i420_of_the_same_picture_look_the_same() -> None:
    picture = np.random.default_rng(4).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    planar = cv2.cvtColor(picture, cv2.COLOR_RGB2YUV_I420)
    u, v = planar[48:].reshape(2, 24, 32)
    interleaved = np.concatenate([planar[:48].ravel(), np.stack([u, v], -1).ravel()])

    assert np.array_equal(read_rgb(planar, "i420", 64, 48), read_rgb(interleaved, "nv12", 64, 48))


def test_alpha_is_shown_over_white() -> None:
    pixels = np.array([[[10, 20, 30, 0], [10, 20, 30, 255]]], np.uint8)

    assert read_rgb(pixels, "rgba", 2, 1).tolist() == [[[255, 255, 255], [10, 20, 30]]]
