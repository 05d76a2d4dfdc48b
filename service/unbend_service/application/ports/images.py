"""Encoded pictures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from unbend_service.domain.frames import Bytes, Frame


@dataclass(frozen=True, slots=True)
class ImageHeader:
    """What the first bytes of an encoded image say, before anything is decoded.

    Attributes:
        image_format: ``jpeg``, ``png``, ``webp``, ``tiff`` or ``bmp``.
        width, height: pixels as stored, before EXIF orientation.
        has_alpha: whether the decoded image keeps an alpha channel.
    """

    image_format: str
    width: int
    height: int
    has_alpha: bool


@dataclass(frozen=True, slots=True)
class PictureOrigin:
    """What the header of an encoded picture says of its making.

    Attributes:
        aspect: width over height, upright.
        camera: a name for the camera, lens and focal length; None if the file names none.
    """

    aspect: float
    camera: str | None


@dataclass(frozen=True, slots=True)
class DecodedImage:
    """A decoded picture, upright (EXIF orientation applied).

    Attributes:
        frame: rgb24, rgba or gray8; yuvj420p where planes were asked for.
        image_format: of the file it came from.
        exif: EXIF block without its orientation, to be written back; None if there was none.
        icc_profile: bytes to be written back; None if there was none or it no longer applies.
        upright: whether the file was stored upright, so that its own bytes show the same picture.
        chroma_subsampling: of a jpeg, ``4:4:4``, ``4:2:2`` or ``4:2:0``, kept when jpeg is written; None if unknown.
    """

    frame: Frame
    image_format: str
    exif: bytes | None = None
    icc_profile: bytes | None = None
    upright: bool = True
    chroma_subsampling: str | None = None


class ImageCodec(Protocol):
    """Encoded images to frames and back. Thread-safe; blocking."""

    def start(self) -> None:
        """Makes ready what decodes; returns at once."""
        ...

    def close(self) -> None:
        """Frees what it holds; what is decoded then may fail."""
        ...

    def probe(self, body: bytes) -> ImageHeader:
        """Reads the header only.

        Raises:
            EmptyBody, UnsupportedMediaType, InvalidImage, TooManyPixels.
        """
        ...

    def origin(self, body: bytes) -> PictureOrigin:
        """Reads the header only; raises as :meth:`probe`."""
        ...

    def decode(self, body: bytes, planes: bool = False) -> DecodedImage:
        """Raises as :meth:`probe`, and InvalidImage for a broken body.

        Args:
            planes: whether a jpeg may be left as planes, because it is to be encoded as a jpeg again; where the codec
                cannot, it comes packed all the same.
        """
        ...

    def decode_grey(self, body: bytes, longest_px: int) -> Bytes:
        """(height, width) uint8, upright, reduced so that the longer side is near ``longest_px`` (never enlarged)."""
        ...

    def encode(self, image: DecodedImage, image_format: str, quality: int) -> bytes:
        """jpeg, png or webp with the EXIF block and ICC profile of ``image``; ``quality`` is 1..100.

        Raises:
            InvalidOption: a format that is not written.
        """
        ...
