"""Pictures of Pillow and PyAV go in and come out; without those packages an error says how to get them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from PIL import Image

import unbend
from tests.client.conftest import Server

IDENTITY = {"strength": 0.0, "fit": "keep"}


@pytest.mark.parametrize(
    ("mode", "pixel_format", "back"),
    [
        ("L", "gray8", "L"),
        ("RGB", "rgb24", "RGB"),
        ("RGBA", "rgba", "RGBA"),
        ("1", "gray8", "L"),
        ("P", "rgb24", "RGB"),
        ("LA", "rgba", "RGBA"),
        ("CMYK", "rgb24", "RGB"),
    ],
)
def test_a_pillow_image_is_sent_as_it_looks_and_comes_back_as_one(
    client: unbend.Client, picture: np.ndarray, mode: str, pixel_format: str, back: str
) -> None:
    image = Image.fromarray(picture).convert(mode)

    correction = client.correct(image, **IDENTITY)

    assert correction.pixel_format == pixel_format
    assert correction.to_pil().mode == back
    assert np.array_equal(np.asarray(correction.to_pil()), np.asarray(image.convert(back)))


def test_a_pillow_image_may_be_sent_in_another_order_of_channels(client: unbend.Client, picture: np.ndarray) -> None:
    image = Image.fromarray(picture)

    for pixel_format in ("bgr24", "bgra"):
        correction = client.correct(image, pixel_format=pixel_format, **IDENTITY)
        assert np.array_equal(correction.image[..., 2::-1], picture)
        assert np.array_equal(np.asarray(correction.to_pil().convert("RGB")), picture)


def test_a_pillow_image_of_more_than_eight_bits_is_refused_and_the_remedy_named(client: unbend.Client) -> None:
    with pytest.raises(unbend.InvalidFrame, match=r"convert\('RGB'\)"):
        client.correct(Image.new("I;16", (4, 4)))


def test_a_file_opens_as_a_pillow_image(client: unbend.Client, picture: np.ndarray) -> None:
    correction = client.correct(cv2.imencode(".png", picture)[1].tobytes(), answer_format="webp")

    assert correction.pixel_format == "webp"
    assert correction.to_pil().format == "WEBP"
    assert correction.to_av().width == 64


@pytest.mark.parametrize("name", ["yuv420p", "nv12", "rgb24", "bgr24", "rgba", "bgra", "gray", "yuv444p"])
@pytest.mark.parametrize("size", [(64, 48), (70, 46), (63, 47)])
def test_a_pyav_frame_is_sent_without_its_padding(client: unbend.Client, name: str, size: tuple[int, int]) -> None:
    width, height = size
    if width % 2 and name in ("yuv420p", "nv12"):
        pytest.skip("PyAV itself makes no such frame from an array")
    pixels = np.random.default_rng(2).integers(0, 255, (height, width, 3), dtype=np.uint8)
    frame = av.VideoFrame.from_ndarray(pixels, format="rgb24").reformat(format=name)

    correction = client.correct(frame, **IDENTITY)

    same = name if name != "yuv444p" else "rgb24"
    assert np.array_equal(correction.image, frame.to_ndarray(format=same))
    assert correction.to_av().format.name == same
    assert np.array_equal(correction.to_av().to_ndarray(), frame.to_ndarray(format=same))
    assert client.estimate(frame).outcome is unbend.Outcome.CORRECTED


def test_an_odd_frame_with_halved_chroma_is_sent_as_rgb(client: unbend.Client) -> None:
    frame = av.VideoFrame(63, 47, "yuv420p")
    for plane in frame.planes:
        plane.update(bytes([128]) * plane.buffer_size)

    correction = client.correct(frame, **IDENTITY)

    assert correction.pixel_format == "rgb24"
    assert correction.image.shape == (47, 63, 3)


def frames_of(count: int, picture: np.ndarray) -> Iterator[av.VideoFrame]:
    for index in range(count):
        frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
        frame.pts, frame.time_base = index, Fraction(1, 25)
        yield frame


def test_a_stream_takes_pyav_frames_with_their_times_and_gives_them_back(
    client: unbend.Client, picture: np.ndarray
) -> None:
    with client.stream(64, 48, "i420", **IDENTITY) as stream:
        results = list(stream.correct(frames_of(3, picture)))

    assert [result.timestamp_us for result in results] == [0, 40_000, 80_000]
    expected = next(frames_of(1, picture)).reformat(format="yuv420p")
    for result in results:
        assert result.image.shape == (72, 64)
        assert np.array_equal(result.to_av().to_ndarray(), expected.to_ndarray())
        assert result.to_pil().size == (64, 48)


def test_a_stream_of_odd_halved_chroma_takes_pyav_frames_too(client: unbend.Client) -> None:
    frame = av.VideoFrame.from_ndarray(np.full((47, 63, 3), 90, np.uint8), format="rgb24")

    with client.stream(63, 47, "i420", **IDENTITY) as stream:
        (result,) = stream.correct([frame])

    assert result.image.shape == (63 * 47 + 2 * 32 * 24,)
    assert result.to_pil().size == (63, 47)
    with pytest.raises(unbend.InvalidFrame, match="even sizes"):
        result.to_av()


def test_a_stream_takes_pillow_images(client: unbend.Client, picture: np.ndarray) -> None:
    with client.stream(64, 48, "bgr24", **IDENTITY) as stream:
        (result,) = stream.correct([Image.fromarray(picture)])

    assert np.array_equal(result.image[..., ::-1], picture)


async def test_the_asynchronous_face_takes_them_too(server: Server, picture: np.ndarray) -> None:
    async with unbend.AsyncClient(server.target) as client:
        correction = await client.correct(Image.fromarray(picture), **IDENTITY)
        async with client.stream(64, 48, **IDENTITY) as stream:
            results = [result async for result in stream.correct(frames_of(2, picture))]

    assert np.array_equal(correction.image, picture)
    assert [result.timestamp_us for result in results] == [0, 40_000]
    assert np.array_equal(results[0].image, picture)


def test_what_only_looks_like_an_array_is_read_as_one(client: unbend.Client, picture: np.ndarray) -> None:
    class Tensor:
        def __array__(self, dtype: object = None, copy: object = None) -> np.ndarray:
            return picture

    assert np.array_equal(client.correct(Tensor(), **IDENTITY).image, picture)


@pytest.mark.parametrize("image", ["photo.jpg", Path("photo.jpg"), 5, None, [[1, 2], [3, 4]]])
def test_what_is_no_picture_is_refused_by_name(client: unbend.Client, image: object) -> None:
    with pytest.raises(unbend.InvalidFrame, match=type(image).__name__) as refused:
        client.correct(image)
    assert ("read_bytes" in str(refused.value)) == isinstance(image, str | Path)


WITHOUT = """
import sys

class Wall:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("PIL", "av"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Wall())
import numpy as np
import unbend

record = unbend.GridRecord("id", 1.0, "given", unbend.Outcome.CORRECTED, "", 1.0, "")
correction = unbend.Correction(np.zeros((4, 6, 3), np.uint8), record, "rgb24")
assert "data:image/png" in correction._repr_html_()
for convert in (correction.to_pil, correction.to_av):
    try:
        convert()
    except ImportError as error:
        assert isinstance(error, unbend.MissingPackage)
        print(error)
"""


def test_a_missing_package_is_named_with_the_command_that_installs_it() -> None:
    result = subprocess.run([sys.executable, "-c", WITHOUT], capture_output=True, text=True, timeout=60, check=False)

    assert result.returncode == 0, result.stderr
    assert "pip install pillow" in result.stdout
    assert "pip install 'unbend[video]'" in result.stdout
