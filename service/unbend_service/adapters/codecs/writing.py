"""What Pillow and the JPEG libraries are told when a picture is written."""

from __future__ import annotations

import zlib

import numpy as np
from PIL import Image

from unbend_service.adapters.codecs.jpegs import encode_packed, encode_planes
from unbend_service.adapters.codecs.samples import describes
from unbend_service.application.ports import DecodedImage
from unbend_service.domain.errors import InvalidFrame
from unbend_service.domain.frames import Frame, PixelFormat

_RAW_MODES = {
    PixelFormat.GRAY8: ("L", "L"),
    PixelFormat.RGB24: ("RGB", "RGB"),
    PixelFormat.BGR24: ("RGB", "BGR"),
    PixelFormat.RGBA: ("RGBA", "RGBA"),
    PixelFormat.BGRA: ("RGBA", "BGRA"),
}
_PACKED_ORDERS = {PixelFormat.RGB24: "RGB", PixelFormat.BGR24: "BGR"}
JPEG_FORMATS = (*_PACKED_ORDERS, PixelFormat.YUVJ420P)
LONGEST_SIDE_PX = {"jpeg": 65_500, "png": 2**31 - 1, "webp": 16_383}
_MAX_JPEG_EXIF_BYTES = 65_533 - 6
SUBSAMPLING = "4:2:0"


def picture_of(frame: Frame) -> Image.Image:
    modes = _RAW_MODES.get(frame.pixel_format)
    if modes is None:
        raise InvalidFrame(f"{frame.pixel_format} frames are not encoded.", allowed=", ".join(_RAW_MODES))
    mode, raw_mode = modes
    data = np.ascontiguousarray(frame.data)
    return Image.frombuffer(mode, (frame.width, frame.height), data, "raw", raw_mode, 0, 1)


def encode_jpeg(image: DecodedImage, quality: int) -> bytes:
    metadata = metadata_of(image, "jpeg", "RGB")
    kept = metadata.get("exif"), metadata.get("icc_profile")
    frame = image.frame
    if frame.pixel_format is PixelFormat.YUVJ420P:
        return encode_planes(frame.plane_arrays(), quality, *kept)
    pixels = np.ascontiguousarray(frame.data).reshape(frame.height, frame.width, 3)
    order = _PACKED_ORDERS[frame.pixel_format]
    subsampling = image.chroma_subsampling or SUBSAMPLING
    return encode_packed(pixels, order, quality, subsampling, *kept)


def metadata_of(image: DecodedImage, image_format: str, mode: str) -> dict[str, bytes]:
    metadata = {}
    if image.icc_profile is not None and describes(image.icc_profile, mode):
        metadata["icc_profile"] = image.icc_profile
    if image.exif and (image_format != "jpeg" or len(image.exif) <= _MAX_JPEG_EXIF_BYTES):
        metadata["exif"] = b"Exif\0\0" + image.exif
    return metadata


def options_of(image: DecodedImage, image_format: str, quality: int) -> dict[str, object]:
    if image_format == "jpeg":
        return {"quality": quality, "subsampling": image.chroma_subsampling or SUBSAMPLING}
    if image_format == "webp":
        return {"quality": quality, "method": 2}
    # run lengths only: on photographs half the time of the default for a few per cent of size
    return {"compress_level": 1, "compress_type": zlib.Z_RLE}
