from __future__ import annotations

import io
import os
from dataclasses import replace

import numpy as np
import pytest
import simplejpeg
from PIL import Image

from unbend_service.adapters.codecs import planar_jpegs
from unbend_service.adapters.codecs.pillow import PillowCodec
from unbend_service.adapters.codecs.planar_jpegs import PlanarJpegs
from unbend_service.application.ports import Bytes, DecodedImage
from unbend_service.domain.errors import InvalidImage
from unbend_service.domain.frames import PixelFormat
from unbend_service.settings import Settings

SIZE = 66, 46


@pytest.fixture(scope="module")
def codec() -> PillowCodec:
    if not PlanarJpegs().available and not os.environ.get("UNBEND_REQUIRE_SERVERS"):
        pytest.skip("libturbojpeg is not installed")
    return PillowCodec(Settings())


def written(width: int = SIZE[0], height: int = SIZE[1], mode: str = "RGB", **options: object) -> bytes:
    y, x = np.mgrid[:height, :width]
    pixels = np.stack([255 * x / width, 255 * y / height, 128 + 127 * np.sin(x / 9)], axis=-1).astype(np.uint8)
    out = io.BytesIO()
    Image.fromarray(pixels).convert(mode).save(out, "jpeg", **({"quality": 92, "subsampling": "4:2:0"} | options))
    return out.getvalue()


def read(body: bytes) -> Bytes:
    return np.asarray(Image.open(io.BytesIO(body)).convert("RGB"))


@pytest.mark.parametrize("progressive", [False, True])
def test_the_planes_are_those_that_the_file_holds(codec: PillowCodec, progressive: bool) -> None:
    """Luma to the last bit; chroma where a decoder that interpolates it puts it, on average."""
    body = written(progressive=progressive)
    frame = codec.decode(body, planes=True).frame
    assert (frame.pixel_format, frame.width, frame.height) == (PixelFormat.YUVJ420P, *SIZE)
    luma, blue, red = frame.plane_arrays()
    np.testing.assert_array_equal(luma, simplejpeg.decode_jpeg(body, "GRAY")[..., 0])
    full = np.asarray(Image.open(io.BytesIO(body)).convert("YCbCr"), np.float64)
    for plane, wanted in ((blue, full[..., 1]), (red, full[..., 2])):
        halved = wanted.reshape(SIZE[1] // 2, 2, SIZE[0] // 2, 2).mean(axis=(1, 3))
        assert np.abs(plane - halved).mean() < 1.5


def test_a_file_that_is_written_again_shows_the_same(codec: PillowCodec) -> None:
    """With its EXIF block and ICC profile, and nearer to what it was than through packed pixels."""
    block = Image.Exif()
    block[0x010F] = "A maker"
    body = written(exif=block.tobytes(), icc_profile=b"\0" * 16 + b"RGB " + b"\0" * 60)
    planar, packed = codec.decode(body, planes=True), codec.decode(body)
    assert packed.frame.pixel_format is PixelFormat.RGB24
    assert (planar.exif, planar.icc_profile) == (packed.exif, packed.icc_profile)
    again = codec.encode(planar, "jpeg", 95)
    seen = Image.open(io.BytesIO(again))
    assert seen.getexif()[0x010F] == "A maker"
    assert seen.info["icc_profile"] == packed.icc_profile
    assert codec.decode(again).chroma_subsampling == "4:2:0"

    def apart(other: bytes) -> float:
        return float(np.abs(read(other).astype(int) - read(body)).mean())

    assert apart(again) <= apart(codec.encode(packed, "jpeg", 95)) < 1.5


@pytest.mark.parametrize(
    "body",
    [
        written(SIZE[0] - 1),
        written(height=SIZE[1] - 1),
        written(subsampling="4:4:4"),
        written(mode="L"),
        written(mode="CMYK"),
        written(exif=b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"),
    ],
    ids=["odd width", "odd height", "4:4:4", "grey", "cmyk", "turned"],
)
def test_other_files_come_packed(codec: PillowCodec, body: bytes) -> None:
    """As they do to those who ask for no planes."""
    planar, packed = codec.decode(body, planes=True), codec.decode(body)
    assert_same(planar, packed)


def test_a_broken_file_is_refused_in_the_same_words(codec: PillowCodec) -> None:
    """What the library only warns of is an error, and said by who says it better."""
    body = written()
    for broken in (body[: len(body) // 2], body[:-600] + bytes(400)):
        said = []
        for planes in (True, False):
            with pytest.raises(InvalidImage) as refusal:
                codec.decode(broken, planes)
            said.append(str(refusal.value))
        assert said[0] == said[1]


def test_a_file_of_another_size_than_was_checked_is_not_decoded() -> None:
    """Two headers in one file cannot make it larger than the limit."""
    assert PlanarJpegs().decode(written(), (SIZE[0], SIZE[1] - 2)) is None


def test_without_the_library_pictures_come_packed(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is an advantage, not a need."""
    monkeypatch.setattr(planar_jpegs, "LIBRARY", "libno-such-library.so.0")
    codec = PillowCodec(Settings())
    body = written()
    assert not PlanarJpegs(planar_jpegs.LIBRARY).available
    assert_same(codec.decode(body, planes=True), codec.decode(body))


def test_a_library_without_its_functions_is_none() -> None:
    """Another library of that name does no harm."""
    assert not PlanarJpegs("libm.so.6").available


def assert_same(one: DecodedImage, other: DecodedImage) -> None:
    assert one.frame.pixel_format is other.frame.pixel_format is not PixelFormat.YUVJ420P
    np.testing.assert_array_equal(one.frame.data, other.frame.data)
    assert replace(one, frame=other.frame) == other
