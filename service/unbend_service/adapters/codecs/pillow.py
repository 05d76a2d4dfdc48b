"""Encoded images with Pillow: libjpeg-turbo, zlib-ng and libwebp behind one interface. Plain JPEGs go past it (jpegs).

What is read becomes 8-bit gray8, rgb24 or rgba. 16-bit samples lose their lower half; CMYK becomes sRGB, by its ICC
profile where it has one; palettes and transparent colours are resolved. An ICC profile is kept only if it still
describes the samples. Of multi-page TIFFs and of animations within the limit, the first picture is read.
"""

from __future__ import annotations

import io
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

import cv2
import numpy as np
from PIL import Image, ImageFile
from PIL.BmpImagePlugin import BmpImageFile
from PIL.JpegImagePlugin import JpegImageFile, get_sampling
from PIL.PngImagePlugin import PngImageFile
from PIL.TiffImagePlugin import TiffImageFile
from PIL.WebPImagePlugin import WebPImageFile

from unbend_service.adapters.codecs import exif
from unbend_service.adapters.codecs.cameras import camera_name
from unbend_service.adapters.codecs.jpegs import decode_luma, decode_rgb
from unbend_service.adapters.codecs.planar_jpegs import PlanarJpegs
from unbend_service.adapters.codecs.samples import bounded_profile, describes, flat, has_alpha, plain
from unbend_service.adapters.codecs.signatures import announced_size, check_scans, sniff
from unbend_service.adapters.codecs.writing import (
    JPEG_FORMATS,
    LONGEST_SIDE_PX,
    SUBSAMPLING,
    encode_jpeg,
    metadata_of,
    options_of,
    picture_of,
)
from unbend_service.application.ports import Bytes, DecodedImage, ImageHeader, PictureOrigin
from unbend_service.domain.errors import (
    ImageTooCostly,
    InvalidImage,
    InvalidOption,
    TooManyPixels,
    UnbendError,
)
from unbend_service.domain.frames import Frame, PixelFormat

WRITTEN_FORMATS = ("jpeg", "png", "webp")

# Opened by class: Image.open would try other plugins and apply its own, global, pixel limit.
_OPENERS: dict[str, type[ImageFile.ImageFile]] = {
    "jpeg": JpegImageFile,
    "png": PngImageFile,
    "webp": WebPImageFile,
    "tiff": TiffImageFile,
    "bmp": BmpImageFile,
}
_UPRIGHT = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
_PIXEL_FORMATS = {"L": PixelFormat.GRAY8, "RGB": PixelFormat.RGB24, "RGBA": PixelFormat.RGBA}
_MODES = {pixel_format: mode for mode, pixel_format in _PIXEL_FORMATS.items()}
#: More than any camera writes: it would come back with every picture.
_MAX_EXIF_BYTES = 1 << 20
# A reduced decode averages over whole blocks, and the padding of the last block shows in a picture that is only thin.
_SHORTEST_DRAFT_PX = 64
# Half of 1920 is near enough to 1024, and costs far less than the next larger scale.
_REDUCED_SHARE = 0.9
_FIRST_TURNED = 5  # EXIF orientations 5 to 8 exchange width and height


class Limits(Protocol):
    """The settings that bound what is decoded."""

    @property
    def source_pixels(self) -> int: ...

    @property
    def animation_frames(self) -> int: ...


class PillowCodec:
    """Port ImageCodec.

    Args:
        settings: ``source_pixels`` and ``animation_frames`` bound what is decoded.
    """

    def __init__(self, settings: Limits) -> None:
        self.source_pixels = settings.source_pixels
        self.animation_frames = settings.animation_frames
        self._planes = PlanarJpegs()

    def probe(self, body: bytes) -> ImageHeader:
        """Reads the header only; raises EmptyBody, UnsupportedMediaType, InvalidImage, TooManyPixels."""
        image_format = sniff(body)
        image = self._open(body, image_format)
        return ImageHeader(image_format, image.width, image.height, has_alpha(image))

    def origin(self, body: bytes) -> PictureOrigin:
        """Reads the header only; raises as :meth:`probe`."""
        image_format = sniff(body)
        image = self._open(body, image_format)
        block = exif.bare(image.info.get("exif") or b"") if image_format != "tiff" else b""
        turned = exif.orientation(block) >= _FIRST_TURNED
        width, height = (image.height, image.width) if turned else image.size
        return PictureOrigin(width / height, camera_name(block, width, height) if block else None)

    def start(self) -> None:
        """Nothing to do: it works in the calling thread."""

    def close(self) -> None:
        """Nothing to do."""

    def decode(self, body: bytes, planes: bool = False, place: Callable[[int], Bytes] | None = None) -> DecodedImage:
        """Raises as :meth:`probe`, ImageTooCostly, and InvalidImage for a broken body.

        Args:
            planes: see ImageCodec.
            place: gives (n,) uint8 memory that the pixels are decoded into, for files where that is possible.
        """
        image_format = sniff(body)
        image = self._open(body, image_format)
        with _translated(image_format):
            if planes and image_format == "jpeg" and (planar := self._decoded_planes(body, image, place)):
                return planar
            pixels = decode_rgb(body, place) if image_format == "jpeg" and image.mode == "RGB" else None
            if pixels is None:
                image.load()
            # TIFF is turned upright by its plugin, and its EXIF block is the file itself
            block = exif.bare(image.info.get("exif") or b"") if image_format != "tiff" else b""
            method = _UPRIGHT.get(exif.orientation(block))
            profile = bounded_profile(image)
            if pixels is not None and method is None:
                frame = Frame(PixelFormat.RGB24, image.width, image.height, pixels.reshape(-1))
            else:
                picture = plain(image, profile) if pixels is None else Image.fromarray(pixels)
                if method is not None:
                    picture = picture.transpose(method)
                layout = _PIXEL_FORMATS[picture.mode]
                frame = Frame(layout, picture.width, picture.height, np.asarray(picture).reshape(-1))
        return DecodedImage(
            frame,
            image_format,
            exif=(exif.upright(block) if 0 < len(block) <= _MAX_EXIF_BYTES else None),
            icc_profile=profile if describes(profile, _MODES[frame.pixel_format]) else None,
            upright=method is None,
            chroma_subsampling=_subsampling(image),
        )

    def _decoded_planes(
        self, body: bytes, image: Image.Image, place: Callable[[int], Bytes] | None
    ) -> DecodedImage | None:
        """An upright 4:2:0 picture of even size as its planes; None if it is none, or they cannot be had."""
        block = exif.bare(image.info.get("exif") or b"")
        if _UPRIGHT.get(exif.orientation(block)) is not None or _subsampling(image) != SUBSAMPLING:
            return None
        if any(side % 2 for side in image.size):  # simplejpeg encodes planes of even sizes only
            return None
        data = self._planes.decode(body, image.size, place)
        if data is None:
            return None
        profile = bounded_profile(image)
        return DecodedImage(
            Frame(PixelFormat.YUVJ420P, image.width, image.height, data),
            "jpeg",
            exif=(exif.upright(block) if 0 < len(block) <= _MAX_EXIF_BYTES else None),
            icc_profile=profile if describes(profile, "RGB") else None,
            chroma_subsampling=SUBSAMPLING,
        )

    def decode_grey(self, body: bytes, longest_px: int) -> Bytes:
        """(height, width) uint8, upright, its longer side ``longest_px`` at most; raises as :meth:`decode`.

        A JPEG is decoded at the scale n/8 that comes near that, which costs a fraction of a full decode.
        """
        image_format = sniff(body)
        image = self._open(body, image_format)
        with _translated(image_format):
            block = exif.bare(image.info.get("exif") or b"") if image_format != "tiff" else b""
            method = _UPRIGHT.get(exif.orientation(block))
            luma = _reduced_luma(body, image, longest_px) if image_format == "jpeg" else None
            if luma is None:
                image.load()
                luma = np.asarray(flat(plain(image, None)).convert("L"))
            grey: Bytes = luma
            if method is not None:
                grey = np.asarray(Image.fromarray(grey).transpose(method))
        height, width = grey.shape
        share = longest_px / max(width, height)
        if share >= 1:
            return grey
        size = max(1, round(width * share)), max(1, round(height * share))
        return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def encode(self, image: DecodedImage, image_format: str, quality: int) -> bytes:
        """jpeg, png or webp with the EXIF block and ICC profile of ``image``; jpeg shows alpha over white.

        Raises:
            InvalidOption: a format that is not written, a quality outside 1..100, a picture too large for the format.
        """
        if image_format not in WRITTEN_FORMATS:
            raise InvalidOption(f"format={image_format!r} is not written.", allowed=", ".join(WRITTEN_FORMATS))
        if not 1 <= quality <= 100:
            raise InvalidOption(f"quality={quality} is out of range.", allowed="1..100")
        if max(image.frame.width, image.frame.height) > LONGEST_SIDE_PX[image_format]:
            raise InvalidOption(
                f"A picture of {image.frame.width}x{image.frame.height} pixels does not fit into {image_format}.",
                allowed=f"{LONGEST_SIDE_PX[image_format]} pixels a side, or png",
            )
        if image_format == "jpeg" and image.frame.pixel_format in JPEG_FORMATS:
            return encode_jpeg(image, quality)
        picture = picture_of(image.frame)
        if image_format == "jpeg":
            picture = flat(picture)
        elif image_format == "webp" and picture.mode == "L":
            picture = picture.convert("RGB")
        options = metadata_of(image, image_format, picture.mode) | options_of(image, image_format, quality)
        out = io.BytesIO()
        with _translated(image_format):
            picture.save(out, image_format, **options)
        return out.getvalue()

    def _open(self, body: bytes, image_format: str) -> ImageFile.ImageFile:
        """Reads the header and holds it against the limits, before any pixel is allocated."""
        announced = announced_size(body, image_format)
        if announced is not None:
            self.check_size(*announced)
        with _translated(image_format), _without_warnings():
            if image_format == "jpeg":
                check_scans(body)
            image = _OPENERS[image_format](io.BytesIO(body))
            self.check_size(*image.size)
            frames = 1 if image_format == "tiff" else getattr(image, "n_frames", 1)
        if frames > self.animation_frames:
            raise InvalidImage(
                f"The image is an animation of {frames} frames.",
                allowed="a still image" if self.animation_frames == 1 else f"{self.animation_frames} frames",
                setting="animation_frames",
            )
        return image

    def check_size(self, width: int, height: int) -> None:
        """Raises InvalidImage, TooManyPixels."""
        if width < 1 or height < 1:
            raise InvalidImage(f"The header announces {width}x{height} pixels.", allowed="at least 1x1")
        if width * height > self.source_pixels:
            raise TooManyPixels(
                f"The header announces {width}x{height} = {width * height} pixels.",
                allowed=f"{self.source_pixels} pixels",
                setting="source_pixels",
            )


_FILTERS = threading.Lock()


@contextmanager
def _without_warnings() -> Iterator[None]:
    """Pillow warns of odd metadata that it then skips; the filters are global to the process, hence the lock."""
    with _FILTERS, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@contextmanager
def _translated(image_format: str) -> Iterator[None]:
    """Pillow's plugins raise nearly anything on broken input; all of it is InvalidImage here."""
    try:
        yield
    except UnbendError:
        raise
    except MemoryError as error:
        raise ImageTooCostly(
            f"Decoding the {image_format} image takes more memory than is granted.", setting="decode_memory_bytes"
        ) from error
    except Image.DecompressionBombError as error:
        raise TooManyPixels(str(error), setting="source_pixels") from error
    except Exception as error:
        raise InvalidImage(f"The {image_format} image is broken or cut off: {error}") from error


def _reduced_luma(body: bytes, image: Image.Image, longest_px: int) -> Bytes | None:
    share = min(1.0, _REDUCED_SHARE * longest_px / max(image.size))
    if min(image.size) < _SHORTEST_DRAFT_PX:
        share = 1.0
    return decode_luma(body, max(1, round(image.width * share)), max(1, round(image.height * share)))


def _subsampling(image: Image.Image) -> str | None:
    if not isinstance(image, JpegImageFile):
        return None
    return {0: "4:4:4", 1: "4:2:2", 2: "4:2:0"}.get(get_sampling(image))
