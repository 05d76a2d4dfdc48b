"""Port ImageCodec: what is decoded in another process is what would have been decoded here, refusals included."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageCms

from tests.fakes import RecordingMeter
from unbend_service.adapters.codecs.pillow import PillowCodec
from unbend_service.adapters.decoding.codec import IsolatedCodec
from unbend_service.adapters.decoding.pool import DecoderPool
from unbend_service.domain.errors import InvalidImage, TooManyPixels, UnbendError
from unbend_service.settings import Settings

SETTINGS = Settings(source_pixels=2_000_000, decoders=1)


@pytest.fixture(scope="module")
def isolated() -> Iterator[IsolatedCodec]:
    codec = IsolatedCodec(DecoderPool(SETTINGS, RecordingMeter()), PillowCodec(SETTINGS))
    codec.start()
    yield codec
    codec.close()


def picture(mode: str = "RGB", width: int = 300, height: int = 200) -> Image.Image:
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    channels = [255 * x / width, 255 * y / height, np.where((x < width / 3) & (y < height / 2), 220, 30)]
    return Image.fromarray(np.stack(channels, -1).astype(np.uint8)).convert(mode)


def encoded(image: Image.Image, image_format: str, **options: Any) -> bytes:
    out = io.BytesIO()
    image.save(out, image_format, **options)
    return out.getvalue()


def turned(orientation: int) -> bytes:
    block = Image.Exif()
    block[0x0112] = orientation
    block[0x010F], block[0x0110] = "A maker", "Its camera"
    block.get_ifd(0x8769)[0x920A] = 35.0
    return block.tobytes()


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def many_scans(scans: int) -> bytes:
    """A progressive JPEG whose last scan is there again and again."""
    body = encoded(picture(), "jpeg", progressive=True)
    last = body.rindex(b"\xff\xda")
    return body[:-2] + body[last:-2] * scans + body[-2:]


SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
BODIES: dict[str, bytes] = {
    "jpeg": encoded(picture(), "jpeg"),
    "jpeg 4:4:4": encoded(picture(), "jpeg", subsampling="4:4:4"),
    "jpeg grey": encoded(picture("L"), "jpeg"),
    "jpeg cmyk": encoded(picture("CMYK"), "jpeg"),
    "jpeg progressive": encoded(picture(), "jpeg", progressive=True),
    "jpeg turned": encoded(picture(), "jpeg", exif=turned(6)),
    "jpeg mirrored, profile": encoded(picture(), "jpeg", exif=turned(2), icc_profile=SRGB),
    "jpeg cut off": encoded(picture(), "jpeg")[:2000],
    "jpeg trailing bytes": encoded(picture(), "jpeg") + b"trailing",
    "jpeg bomb of scans": many_scans(200),
    "jpeg some more scans": many_scans(20),
    "png": encoded(picture(), "png"),
    "png alpha": encoded(picture("RGBA"), "png"),
    "png palette": encoded(picture().quantize(), "png"),
    "png 16": encoded(Image.fromarray(np.arange(60_000, dtype=np.uint16).reshape(200, 300)), "png"),
    "png large profile": encoded(picture(), "png", icc_profile=SRGB + bytes(5 << 20)),
    "png exif bomb": encoded(picture(), "png", exif=turned(3) + bytes(3 << 20)),
    "png announces much": b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", 60000, 60000, 8, 2, 0, 0, 0)),
    "png text bomb": encoded(picture(), "png")[:33] + chunk(b"zTXt", b"k\0\0" + zlib.compress(bytes(80 << 20))),
    "webp": encoded(picture(), "webp"),
    "webp alpha": encoded(picture("RGBA"), "webp"),
    "webp animation": encoded(picture(), "webp", save_all=True, append_images=[picture("L")] * 3),
    "webp cut off": encoded(picture(), "webp")[:200],
    "tiff": encoded(picture(), "tiff"),
    "tiff lzw": encoded(picture(), "tiff", compression="tiff_lzw"),
    "tiff cut off": encoded(picture(), "tiff")[:1000],
    "bmp": encoded(picture(), "bmp"),
    "bmp cut off": encoded(picture(), "bmp")[:40],
    "empty": b"",
    "gif": encoded(picture().quantize(), "gif"),
    "text": b"no picture at all",
    "too many pixels": encoded(picture(width=2000, height=1001), "png"),
}


def outcome(codec: PillowCodec | IsolatedCodec, call: str, body: bytes) -> object:
    """Everything that a caller sees."""
    try:
        if call == "grey":
            return codec.decode_grey(body, 128).tobytes()
        if call == "probe":
            return codec.probe(body), codec.origin(body)
        image = codec.decode(body, planes=call == "planes")
    except UnbendError as error:
        return type(error), error.allowed, error.setting
    frame = image.frame
    return (
        (frame.pixel_format, frame.width, frame.height, frame.data.tobytes()),
        (image.image_format, image.exif, image.icc_profile, image.upright, image.chroma_subsampling),
    )


@pytest.mark.parametrize("name", BODIES)
def test_both_codecs_see_the_same(isolated: IsolatedCodec, name: str) -> None:
    """Pixels, metadata and refusals."""
    local = PillowCodec(SETTINGS)
    for call in ("probe", "decode", "planes", "grey"):
        assert outcome(isolated, call, BODIES[name]) == outcome(local, call, BODIES[name]), call


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("jpeg bomb of scans", InvalidImage),
        ("png large profile", InvalidImage),
        ("png text bomb", InvalidImage),
        ("webp animation", InvalidImage),
        ("png announces much", TooManyPixels),
        ("too many pixels", TooManyPixels),
    ],
)
def test_bombs_are_refused(isolated: IsolatedCodec, name: str, kind: type[UnbendError]) -> None:
    """Small files that want much are named as what they are."""
    with pytest.raises(kind):
        isolated.decode(BODIES[name])


def test_a_picture_with_some_more_scans_is_fine(isolated: IsolatedCodec) -> None:
    """What an encoder may well write is not refused."""
    assert isolated.decode(BODIES["jpeg some more scans"]).frame.width == 300


def test_an_exif_bomb_does_not_come_back(isolated: IsolatedCodec) -> None:
    """The picture is turned as it says, and megabytes of metadata are left behind."""
    image = isolated.decode(BODIES["png exif bomb"])
    assert not image.upright
    assert image.exif is None


def test_it_writes_what_the_local_codec_writes(isolated: IsolatedCodec) -> None:
    """Encoding is the same work."""
    local = PillowCodec(SETTINGS)
    image = local.decode(BODIES["jpeg mirrored, profile"])
    assert isolated.encode(image, "png", 90) == local.encode(image, "png", 90)
