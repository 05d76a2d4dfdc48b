from __future__ import annotations

import io
import struct
import tracemalloc
import zlib
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageCms

from unbend_service.adapters.codecs.pillow import PillowCodec
from unbend_service.application.ports import DecodedImage
from unbend_service.domain.errors import (
    EmptyBody,
    InvalidFrame,
    InvalidImage,
    InvalidOption,
    TooManyPixels,
    UnbendError,
    UnsupportedMediaType,
)
from unbend_service.domain.frames import Frame, PixelFormat, frame_size_bytes
from unbend_service.settings import Settings

CODEC = PillowCodec(Settings(source_pixels=100_000_000, animation_frames=1))
ORIENTATION = 0x0112
TRANSPOSED = {
    1: None,
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_90,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_270,
}


def picture(mode: str = "RGB", width: int = 96, height: int = 64) -> Image.Image:
    """Smooth, and different in each corner."""
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    red, green = 255 * x / (width - 1), 255 * y / (height - 1)
    blue = np.where((x < width / 3) & (y < height / 2), 220, 30)
    return Image.fromarray(np.stack([red, green, blue], -1).astype(np.uint8)).convert(mode)


def encoded(image: Image.Image, image_format: str, **options: Any) -> bytes:
    out = io.BytesIO()
    image.save(out, image_format, **options)
    return out.getvalue()


def pixels(image: DecodedImage) -> np.ndarray[Any, Any]:
    return image.frame.plane_arrays()[0]


def difference(image: DecodedImage, expected: Image.Image) -> float:
    return float(np.abs(pixels(image).astype(int) - np.asarray(expected).astype(int)).mean())


def exif_block(orientation: int) -> bytes:
    block = Image.Exif()
    block[ORIENTATION] = orientation
    block[0x010F] = "A maker"
    block.get_ifd(0x8769)[0x927C] = b"maker note"
    return block.tobytes()


def srgb() -> bytes:
    return ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png_header(width: int, height: int) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + png_chunk(b"IHDR", header) + png_chunk(b"IDAT", zlib.compress(b"\0" * 1000))


def animation(image_format: str, frames: int = 2) -> bytes:
    turned = picture().transpose(Image.Transpose.ROTATE_180)
    others = [turned if i % 2 == 0 else picture() for i in range(frames - 1)]
    return encoded(picture(), image_format, save_all=True, append_images=others, duration=100)


@pytest.mark.parametrize("image_format", ["jpeg", "png", "webp", "tiff", "bmp"])
def test_each_accepted_format_is_read(image_format: str) -> None:
    """A picture comes out as it went in, whichever accepted format carries it."""
    body = encoded(picture(), image_format, **({"quality": 95} if image_format in ("jpeg", "webp") else {}))
    header = CODEC.probe(body)
    assert (header.image_format, header.width, header.height, header.has_alpha) == (image_format, 96, 64, False)
    image = CODEC.decode(body)
    assert image.image_format == image_format
    assert image.frame.pixel_format is PixelFormat.RGB24
    assert difference(image, picture()) < (3 if image_format in ("jpeg", "webp") else 1e-9)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("image_format", ["jpeg", "png", "webp"])
def test_orientation_is_applied_once(image_format: str, orientation: int) -> None:
    """A picture stored turned or mirrored comes out upright, and its EXIF no longer asks for a turn."""
    method = TRANSPOSED[orientation]
    stored = picture() if method is None else picture().transpose(method)
    options: dict[str, Any] = {"jpeg": {"quality": 95}, "webp": {"lossless": True}}.get(image_format, {})
    body = encoded(stored, image_format, exif=exif_block(orientation), **options)
    image = CODEC.decode(body)
    assert difference(image, picture()) < 3
    assert image.upright == (orientation == 1)
    grey = CODEC.decode_grey(body, 1000)
    assert np.abs(grey.astype(int) - np.asarray(picture("L")).astype(int)).mean() < 3
    again = Image.open(io.BytesIO(CODEC.encode(image, image_format, 90)))
    assert again.size == (96, 64)
    assert again.getexif()[ORIENTATION] == 1
    assert again.getexif()[0x010F] == "A maker"
    assert again.getexif().get_ifd(0x8769)[0x927C] == b"maker note"


def test_tiff_orientation_is_applied() -> None:
    """A TIFF keeps its orientation in its own directory; it is applied too."""
    tags = {ORIENTATION: 6}
    body = encoded(picture().transpose(Image.Transpose.ROTATE_90), "tiff", tiffinfo=tags)
    assert difference(CODEC.decode(body), picture()) == 0


@pytest.mark.parametrize("image_format", ["jpeg", "png", "webp"])
def test_icc_profile_is_kept(image_format: str) -> None:
    """Colours mean the same after correction: the profile is written back byte for byte."""
    image = CODEC.decode(encoded(picture(), image_format, icc_profile=srgb()))
    again = Image.open(io.BytesIO(CODEC.encode(image, image_format, 90)))
    assert again.info["icc_profile"] == srgb()


def test_a_profile_of_another_colour_space_is_dropped() -> None:
    """A profile that does not describe the samples that are written would only spoil them."""
    image = CODEC.decode(encoded(picture("LA"), "png", icc_profile=srgb()[:16] + b"GRAY" + srgb()[20:]))
    assert image.frame.pixel_format is PixelFormat.RGBA
    assert image.icc_profile is None


def test_the_thumbnail_of_the_old_picture_is_not_kept() -> None:
    """An EXIF thumbnail would show the picture as it was before correction."""
    block = bytearray(exif_block(1)[6:])
    order = "<" if block[:2] == b"II" else ">"
    (start,) = struct.unpack_from(order + "I", block, 4)
    (count,) = struct.unpack_from(order + "H", block, start)
    link = start + 2 + 12 * count
    struct.pack_into(order + "I", block, link, len(block))
    body = encoded(picture(), "png", exif=bytes(block) + struct.pack(order + "HI", 0, 0))
    kept = CODEC.decode(body).exif
    assert kept is not None
    assert struct.unpack_from(order + "I", kept, link) == (0,)


@pytest.mark.parametrize("block", [b"nonsense", b"II*\0", b"II*\0\xff\xff\xff\x7f", b"MM\0*\0\0\0\x08\xff\xff"])
def test_broken_exif_is_dropped(block: bytes) -> None:
    """A picture with an unreadable EXIF block is corrected all the same."""
    image = CODEC.decode(encoded(picture(), "png", exif=block))
    assert image.exif is None
    assert difference(image, picture()) == 0


@pytest.mark.parametrize(
    ("mode", "image_format", "expected"),
    [
        ("1", "png", PixelFormat.GRAY8),
        ("L", "png", PixelFormat.GRAY8),
        ("L", "jpeg", PixelFormat.GRAY8),
        ("L", "bmp", PixelFormat.GRAY8),
        ("LA", "png", PixelFormat.RGBA),
        ("P", "png", PixelFormat.RGB24),
        ("P", "bmp", PixelFormat.RGB24),
        ("RGBA", "png", PixelFormat.RGBA),
        ("RGBA", "webp", PixelFormat.RGBA),
        ("RGBA", "tiff", PixelFormat.RGBA),
        ("CMYK", "jpeg", PixelFormat.RGB24),
        ("CMYK", "tiff", PixelFormat.RGB24),
        ("YCbCr", "tiff", PixelFormat.RGB24),
    ],
)
def test_each_kind_of_samples_becomes_8_bit(mode: str, image_format: str, expected: PixelFormat) -> None:
    """Grey stays grey, alpha stays, and everything else becomes RGB that looks the same."""
    source = picture(mode)
    if mode in ("LA", "RGBA"):
        source.putalpha(picture("L"))
    image = CODEC.decode(encoded(source, image_format, **({"lossless": True} if image_format == "webp" else {})))
    assert image.frame.pixel_format is expected
    mode_out = {PixelFormat.GRAY8: "L", PixelFormat.RGB24: "RGB", PixelFormat.RGBA: "RGBA"}[expected]
    assert difference(image, source.convert(mode_out)) < 3


def test_a_transparent_palette_keeps_its_alpha() -> None:
    """A palette with a transparent entry becomes rgba."""
    body = encoded(picture("P"), "png", transparency=0)
    assert CODEC.probe(body).has_alpha
    image = CODEC.decode(body)
    assert image.frame.pixel_format is PixelFormat.RGBA
    assert set(np.unique(pixels(image)[..., 3])) <= {0, 255}


@pytest.mark.parametrize("image_format", ["png", "tiff"])
def test_16_bit_grey_keeps_its_upper_half(image_format: str) -> None:
    """16-bit samples become 8-bit ones of the same brightness."""
    deep = np.arange(96 * 64, dtype=np.uint16).reshape(64, 96) * 10
    image = CODEC.decode(encoded(Image.fromarray(deep), image_format))
    assert image.frame.pixel_format is PixelFormat.GRAY8
    np.testing.assert_array_equal(pixels(image), deep >> 8)
    assert CODEC.decode_grey(encoded(Image.fromarray(deep), image_format), 96).shape == (64, 96)


def test_16_bit_colour_keeps_its_upper_half() -> None:
    """16-bit RGB PNGs are read as their 8-bit counterpart."""
    deep = (np.arange(8 * 6 * 3).reshape(6, 8, 3) * 400).astype(">u2")
    rows = b"".join(b"\0" + row.tobytes() for row in deep)
    header = struct.pack(">IIBBBBB", 8, 6, 16, 2, 0, 0, 0)
    chunks = [png_chunk(b"IHDR", header), png_chunk(b"IDAT", zlib.compress(rows)), png_chunk(b"IEND", b"")]
    image = CODEC.decode(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))
    np.testing.assert_array_equal(pixels(image), (deep >> 8).astype(np.uint8))


def test_32_bit_samples_are_refused() -> None:
    """Floating point TIFFs have no agreed white; they are refused by name."""
    with pytest.raises(InvalidImage, match="8 or 16 bits"):
        CODEC.decode(encoded(Image.fromarray(np.zeros((4, 4), np.float32)), "tiff"))


def test_cmyk_is_converted_by_its_profile_or_without() -> None:
    """A broken CMYK profile does not stop a picture."""
    profile = srgb()[:16] + b"CMYK" + srgb()[20:]
    image = CODEC.decode(encoded(picture("CMYK"), "jpeg", icc_profile=profile, quality=95))
    assert image.icc_profile is None
    assert image.frame.pixel_format is PixelFormat.RGB24


@pytest.mark.parametrize("body", [b"", bytearray()])
def test_an_empty_body_is_named(body: bytes) -> None:
    """Nothing is not an image, and is called nothing."""
    with pytest.raises(EmptyBody):
        CODEC.decode(bytes(body))


@pytest.mark.parametrize("body", [b"hello, I am text", b"GIF89a" + bytes(100), b"<svg/>", b"\0" * 64, b"%PDF-1.7"])
def test_other_bytes_are_an_unsupported_type(body: bytes) -> None:
    """What is accepted is decided by the bytes, and the answer says what that is."""
    with pytest.raises(UnsupportedMediaType, match="jpeg, png, webp, tiff, bmp"):
        CODEC.probe(body)


@pytest.mark.parametrize("image_format", ["jpeg", "png", "webp", "tiff", "bmp"])
@pytest.mark.parametrize("share", [0.02, 0.3, 0.9])
def test_a_truncated_image_is_refused(image_format: str, share: float) -> None:
    """Half a picture is an error, never a picture with a grey lower half."""
    noise = np.random.default_rng(1).integers(0, 255, (200, 300, 3), dtype=np.uint8)
    body = encoded(Image.fromarray(noise), image_format)
    cut = body[: max(13, int(len(body) * share))]
    with pytest.raises(InvalidImage):
        CODEC.decode(cut)
    with pytest.raises(InvalidImage):
        CODEC.decode_grey(cut, 64)


@pytest.mark.parametrize("image_format", ["jpeg", "png", "webp", "tiff", "bmp"])
def test_damaged_bytes_never_raise_anything_untyped(image_format: str) -> None:
    """Whatever the bytes, the answer is a picture or a typed error."""
    body = bytearray(encoded(picture(), image_format))
    random = np.random.default_rng(7)
    for _ in range(60):
        damaged = bytearray(body)
        for position in random.integers(4, len(body), 5):
            damaged[position] = random.integers(256)
        try:
            CODEC.decode(bytes(damaged))
            CODEC.decode_grey(bytes(damaged), 32)
        except UnbendError:
            continue


def bombs() -> dict[str, bytes]:
    webp = b"RIFF\xff\xff\0\0WEBPVP8X" + struct.pack("<II", 10, 0)
    webp += (16_382).to_bytes(3, "little") + (16_382).to_bytes(3, "little") + bytes(64)
    jpeg = bytearray(encoded(picture(), "jpeg"))
    start = jpeg.index(b"\xff\xc0") + 5
    jpeg[start : start + 4] = struct.pack(">HH", 60_000, 60_000)
    bmp = bytearray(encoded(picture(), "bmp"))
    bmp[18:26] = struct.pack("<ii", 30_000, 30_000)
    tiff = encoded(picture("L"), "tiff")
    tiff = tiff.replace(struct.pack("<HHII", 256, 3, 1, 96), struct.pack("<HHII", 256, 4, 1, 30_000))
    tiff = tiff.replace(struct.pack("<HHII", 257, 3, 1, 64), struct.pack("<HHII", 257, 4, 1, 30_000))
    tiff = tiff.replace(struct.pack("<HHII", 256, 4, 1, 96), struct.pack("<HHII", 256, 4, 1, 30_000))
    tiff = tiff.replace(struct.pack("<HHII", 257, 4, 1, 64), struct.pack("<HHII", 257, 4, 1, 30_000))
    return {"png": png_header(30_000, 30_000), "webp": webp, "jpeg": bytes(jpeg), "bmp": bytes(bmp), "tiff": tiff}


@pytest.mark.parametrize("image_format", ["png", "webp", "jpeg", "bmp"])
def test_a_bare_header_is_enough(image_format: str) -> None:
    """A file that is nothing but the header of a bomb is called by its name too."""
    body = bombs()[image_format]
    length = {"png": 33, "webp": 30, "jpeg": body.find(b"\xff\xc0") + 19, "bmp": 54}
    with pytest.raises(TooManyPixels):
        CODEC.probe(body[: length[image_format]])


@pytest.mark.parametrize("image_format", ["png", "webp", "jpeg", "bmp", "tiff"])
def test_a_bomb_is_refused_by_its_header(image_format: str) -> None:
    """A header that announces too many pixels is refused, with the setting's name, before anything is allocated."""
    body = bombs()[image_format]
    tracemalloc.start()
    try:
        for read in (CODEC.probe, CODEC.decode, lambda body: CODEC.decode_grey(body, 64)):
            with pytest.raises(TooManyPixels, match="source_pixels"):
                read(body)
        assert tracemalloc.get_traced_memory()[1] < 4 << 20
    finally:
        tracemalloc.stop()


def test_the_pixel_limit_is_the_setting() -> None:
    """The limit is the setting's, to the pixel."""
    assert PillowCodec(Settings(source_pixels=96 * 64)).decode(encoded(picture(), "png")).frame.width == 96
    with pytest.raises(TooManyPixels):
        PillowCodec(Settings(source_pixels=96 * 64 - 1)).decode(encoded(picture(), "png"))


@pytest.mark.parametrize("image_format", ["png", "webp"])
def test_animations_are_refused_beyond_the_limit(image_format: str) -> None:
    """An animation is refused with what is accepted and the setting; within the limit its first frame is read."""
    with pytest.raises(InvalidImage, match=r"animation of 2 frames.*a still image.*animation_frames"):
        CODEC.probe(animation(image_format))
    image = PillowCodec(Settings(animation_frames=2)).decode(animation(image_format))
    assert difference(image, picture()) < 3
    with pytest.raises(InvalidImage, match=r"3 frames.*2 frames"):
        PillowCodec(Settings(animation_frames=2)).probe(animation(image_format, 3))


def test_the_first_page_of_a_tiff_is_read() -> None:
    """Thumbnails and further pages of a TIFF do not stop it."""
    body = encoded(picture(), "tiff", save_all=True, append_images=[picture("L", 8, 8)])
    assert difference(CODEC.decode(body), picture()) == 0


@pytest.mark.parametrize("image_format", ["jpeg", "png", "webp", "bmp"])
@pytest.mark.parametrize(("width", "height"), [(3000, 2000), (640, 1100), (100, 80), (5000, 3), (1, 1)])
def test_grey_is_reduced_and_never_enlarged(image_format: str, width: int, height: int) -> None:
    """The estimator gets the whole picture at the size it asked for, or smaller if the picture is."""
    source = picture("RGB", width, height) if min(width, height) > 1 else Image.new("RGB", (width, height), "grey")
    grey = CODEC.decode_grey(encoded(source, image_format), 256)
    assert max(grey.shape) == min(256, max(width, height))
    scale = max(grey.shape) / max(width, height)
    assert abs(grey.shape[0] - height * scale) < 1
    assert abs(grey.shape[1] - width * scale) < 1
    expected = np.asarray(source.convert("L").resize(grey.shape[::-1], Image.Resampling.BOX)).astype(int)
    assert np.abs(grey.astype(int) - expected).mean() < 3


@pytest.mark.parametrize(
    "pixel_format",
    [PixelFormat.GRAY8, PixelFormat.RGB24, PixelFormat.BGR24, PixelFormat.RGBA, PixelFormat.BGRA],
)
@pytest.mark.parametrize("image_format", ["jpeg", "png", "webp"])
def test_packed_frames_are_written(pixel_format: PixelFormat, image_format: str) -> None:
    """Every packed frame can be written in every format that is written, colours in the right order."""
    size = frame_size_bytes(pixel_format, 8, 8)
    data = np.zeros(size, np.uint8).reshape(64, -1)
    data[:, :] = {1: [90], 3: [200, 90, 10], 4: [200, 90, 10, 255]}[data.shape[1]]
    image = DecodedImage(Frame(pixel_format, 8, 8, data.reshape(-1)), image_format)
    body = CODEC.encode(image, image_format, 95)
    red, green, blue = Image.open(io.BytesIO(body)).convert("RGB").getpixel((4, 4))
    first, last = (90, 90) if pixel_format is PixelFormat.GRAY8 else (200, 10)
    if pixel_format in (PixelFormat.BGR24, PixelFormat.BGRA):
        first, last = last, first
    assert abs(red - first) + abs(green - 90) + abs(blue - last) < 16


def test_alpha_is_shown_over_white_in_jpeg() -> None:
    """jpeg has no alpha; what was transparent becomes white."""
    clear = DecodedImage(Frame(PixelFormat.RGBA, 8, 8, np.zeros(256, np.uint8)), "png")
    decoded = CODEC.decode(CODEC.encode(clear, "jpeg", 95))
    assert pixels(decoded).min() > 250


def test_what_cannot_be_written_is_named() -> None:
    """An option out of range is answered with what is in range."""
    image = CODEC.decode(encoded(picture(), "png"))
    with pytest.raises(InvalidOption, match="jpeg, png, webp"):
        CODEC.encode(image, "tiff", 90)
    with pytest.raises(InvalidOption, match=r"1\.\.100"):
        CODEC.encode(image, "jpeg", 0)
    long = DecodedImage(Frame(PixelFormat.GRAY8, 17_000, 1, np.zeros(17_000, np.uint8)), "png")
    with pytest.raises(InvalidOption, match="16383"):
        CODEC.encode(long, "webp", 90)
    planar = DecodedImage(Frame(PixelFormat.I420, 2, 2, np.zeros(6, np.uint8)), "png")
    with pytest.raises(InvalidFrame):
        CODEC.encode(planar, "png", 90)


def test_chroma_subsampling_is_kept() -> None:
    """A jpeg with full colour resolution keeps it."""
    for name, number in (("4:4:4", 0), ("4:2:0", 2)):
        image = CODEC.decode(encoded(picture(), "jpeg", subsampling=number))
        assert image.chroma_subsampling == name
        assert CODEC.decode(CODEC.encode(image, "jpeg", 90)).chroma_subsampling == name


def test_long_exif_does_not_stop_a_jpeg() -> None:
    """A block that PNG can hold and JPEG cannot is left out of the JPEG."""
    image = CODEC.decode(encoded(picture(), "png", exif=exif_block(1)[6:] + bytes(70_000)))
    assert image.exif is not None
    assert CODEC.decode(CODEC.encode(image, "png", 90)).exif == image.exif
    assert CODEC.decode(CODEC.encode(image, "jpeg", 90)).exif is None
