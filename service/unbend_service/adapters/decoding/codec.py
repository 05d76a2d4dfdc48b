"""ImageCodec whose decoding happens elsewhere."""

from __future__ import annotations

import math
import re
from typing import Any

from unbend_service.adapters.codecs.pillow import PillowCodec
from unbend_service.adapters.codecs.signatures import announced_size, sniff
from unbend_service.adapters.decoding.pool import DecoderPool
from unbend_service.adapters.decoding.process import Verdict
from unbend_service.application.ports import Bytes, DecodedImage, ImageHeader, PictureOrigin
from unbend_service.domain.errors import InvalidImage
from unbend_service.domain.frames import Frame, PixelFormat, frame_size_bytes

_PIXEL_FORMATS = {kind.value: kind for kind in (PixelFormat.GRAY8, PixelFormat.RGB24, PixelFormat.RGBA)}
_PLANES = _PIXEL_FORMATS | {PixelFormat.YUVJ420P.value: PixelFormat.YUVJ420P}
_CAMERA = re.compile(r"exif:[A-Za-z0-9.:+-]{1,160}")
_CHROMA = (None, "4:4:4", "4:2:2", "4:2:0")


class IsolatedCodec:
    """Port ImageCodec: decodes in the processes of a pool, and encodes, which is work on our own pixels, here.

    Args:
        pool: started and closed with this codec.
        local: encodes, and knows the limits that are checked before a decoder is asked.
    """

    def __init__(self, pool: DecoderPool, local: PillowCodec) -> None:
        self._pool = pool
        self._local = local

    def start(self) -> None:
        self._pool.start()

    def close(self) -> None:
        self._pool.close()

    def probe(self, body: bytes) -> ImageHeader:
        """See ImageCodec."""
        image_format = self._checked(body)
        fields = self._pool.work("probe", body).fields
        return ImageHeader(image_format, *_size(fields), has_alpha=fields.get("alpha") is True)

    def origin(self, body: bytes) -> PictureOrigin:
        """See ImageCodec."""
        self._checked(body)
        fields = self._pool.work("origin", body).fields
        aspect, camera = fields.get("aspect"), fields.get("camera")
        if not isinstance(aspect, float) or not 0 < aspect < math.inf:
            raise _nonsense()
        if camera is not None and not (isinstance(camera, str) and _CAMERA.fullmatch(camera)):
            raise _nonsense()
        return PictureOrigin(aspect, camera)

    def decode(self, body: bytes, planes: bool = False) -> DecodedImage:
        """See ImageCodec; raises ImageTooCostly and MemoryFull too."""
        image_format = self._checked(body)
        verdict = self._pool.work("decode", body, planes=planes)
        fields, parts = verdict.fields, verdict.parts
        width, height = _size(fields)
        pixel_format = (_PLANES if planes else _PIXEL_FORMATS).get(str(fields.get("pixel_format")))
        lengths = [fields.get(name) for name in ("exif", "icc")]
        kept_bytes = sum(_length(length) for length in lengths)
        part = _length(fields.get("part"))
        if (
            pixel_format is None
            or fields.get("chroma") not in _CHROMA
            or len(parts) != part + (2 if kept_bytes else 1)
            or parts[part].size != frame_size_bytes(pixel_format, width, height)
            or (kept_bytes and parts[-1].size != kept_bytes)
        ):
            raise _nonsense()
        kept = parts[-1].tobytes() if kept_bytes else b""
        exif_bytes = _length(lengths[0])
        return DecodedImage(
            Frame(pixel_format, width, height, parts[part]),
            image_format,
            exif=None if lengths[0] is None else kept[:exif_bytes],
            icc_profile=None if lengths[1] is None else kept[exif_bytes:],
            upright=fields.get("upright") is True,
            chroma_subsampling=fields.get("chroma"),
        )

    def decode_grey(self, body: bytes, longest_px: int) -> Bytes:
        """See ImageCodec; raises ImageTooCostly and MemoryFull too."""
        self._checked(body)
        verdict = self._pool.work("grey", body, longest_px=longest_px)
        width, height = _size(verdict.fields)
        return _only(verdict, width * height).reshape(height, width)

    def encode(self, image: DecodedImage, image_format: str, quality: int) -> bytes:
        """See ImageCodec."""
        return self._local.encode(image, image_format, quality)

    def _checked(self, body: bytes) -> str:
        """The format; what the first bytes alone forbid does not reach a decoder."""
        image_format = sniff(body)
        announced = announced_size(body, image_format)
        if announced is not None:
            self._local.check_size(*announced)
        return image_format


def _only(verdict: Verdict, size_bytes: int) -> Bytes:
    if len(verdict.parts) != 1 or verdict.parts[0].size != size_bytes:
        raise _nonsense()
    return verdict.parts[0]


def _size(fields: dict[str, Any]) -> tuple[int, int]:
    width, height = fields.get("width"), fields.get("height")
    if type(width) is not int or type(height) is not int or width < 1 or height < 1:
        raise _nonsense()
    return width, height


def _length(value: object) -> int:
    if value is None:
        return 0
    if type(value) is not int or value < 0:
        raise _nonsense()
    return value


def _nonsense() -> InvalidImage:
    return InvalidImage("The decoder gave no sensible answer to this file.")
