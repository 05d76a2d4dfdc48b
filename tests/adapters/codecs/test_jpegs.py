from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from unbend_service.adapters.codecs.jpegs import decode_luma, decode_rgb, encode_packed
from unbend_service.adapters.codecs.pillow import PillowCodec
from unbend_service.application.ports import Bytes
from unbend_service.settings import Settings


def picture(width: int = 67, height: int = 45) -> Bytes:
    y, x = np.mgrid[:height, :width]
    return np.stack([x * 3 % 256, y * 5 % 256, (x + y) % 256], axis=-1).astype(np.uint8)


def written(mode: str = "RGB", **options: object) -> bytes:
    out = io.BytesIO()
    Image.fromarray(picture()).convert(mode).save(out, "jpeg", **options)
    return out.getvalue()


@pytest.mark.parametrize("subsampling", ["4:4:4", "4:2:2", "4:2:0"])
@pytest.mark.parametrize("progressive", [False, True])
def test_pixels_are_those_that_pillow_reads(subsampling: str, progressive: bool) -> None:
    """The fast way changes no pixel of a plain file."""
    body = written(quality=88, subsampling=subsampling, progressive=progressive)
    pixels = decode_rgb(body)
    assert pixels is not None
    np.testing.assert_array_equal(pixels, np.asarray(Image.open(io.BytesIO(body))))


def test_what_is_not_plain_is_left_to_pillow() -> None:
    """Grey and CMYK files, files that are cut off, and what is no JPEG at all."""
    body = written()
    for other in (written("L"), written("CMYK"), body[: len(body) // 2], b"\xff\xd8\xff", b"GIF89a", b""):
        assert decode_rgb(other) is None


@pytest.mark.parametrize("mode", ["L", "RGB"])
def test_luma_is_reduced_but_not_below_what_was_asked_for(mode: str) -> None:
    """The smallest scale that is large enough is decoded, and at full scale the pixels are those of Pillow."""
    body = written(mode, quality=90)
    full = decode_luma(body, 67, 45)
    half = decode_luma(body, 33, 22)
    assert full is not None
    assert half is not None
    reader = Image.open(io.BytesIO(body))
    reader.draft("L", reader.size)
    np.testing.assert_array_equal(full, np.asarray(reader))
    assert half.shape == (23, 34)
    assert decode_luma(body[:200], 33, 22) is None


@pytest.mark.parametrize("order", ["RGB", "BGR"])
def test_a_file_keeps_its_exif_block_and_a_profile_of_any_size(order: str) -> None:
    """Both are where readers look for them, also a profile that needs several segments, and the picture is unharmed."""
    exif, profile = b"Exif\0\0" + bytes(range(256)) * 255, np.random.default_rng(1).bytes(150_000)
    pixels = picture() if order == "RGB" else np.ascontiguousarray(picture()[..., ::-1])
    body = encode_packed(pixels, order, 95, "4:4:4", exif, profile)
    image = Image.open(io.BytesIO(body))
    assert image.info["icc_profile"] == profile
    assert image.info["exif"] == exif
    assert image.info["jfif"]
    assert np.abs(np.asarray(image).astype(int) - picture()).mean() < 3


def test_the_codec_reads_and_writes_the_same_picture_either_way() -> None:
    """A turned file comes out upright, with its chroma resolution, through the fast way as through Pillow."""
    codec = PillowCodec(Settings())
    exif = Image.Exif()
    exif[0x0112] = 6
    image = codec.decode(written(quality=95, subsampling="4:2:2", exif=exif.tobytes()))
    assert (image.frame.width, image.frame.height, image.upright) == (45, 67, False)
    again = codec.decode(codec.encode(replace(image, exif=None), "jpeg", 95))
    assert again.chroma_subsampling == "4:2:2"
    assert np.abs(again.frame.data.astype(int) - image.frame.data).mean() < 3
