"""What the samples of a loaded picture mean, and the same in eight bits."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image, ImageCms

from unbend_service.domain.errors import InvalidImage

_PROFILE_SPACES = {"L": b"GRAY", "RGB": b"RGB ", "RGBA": b"RGB "}
#: More than any press needs: it would come back with every picture.
_MAX_PROFILE_BYTES = 4 << 20
_WHITE = (255, 255, 255)


def plain(image: Image.Image, profile: bytes | None) -> Image.Image:
    """The loaded picture in mode L, RGB or RGBA."""
    if image.mode.startswith("I;16"):
        return Image.fromarray((np.asarray(image) >> 8).astype(np.uint8))
    if image.mode in ("I", "F"):
        raise InvalidImage("The image has 32-bit samples.", allowed="8 or 16 bits a sample")
    if has_alpha(image):
        return image.convert("RGBA")
    if image.mode == "CMYK" and describes(profile, "CMYK") and profile is not None:
        return _to_srgb(image, profile)
    if image.mode in ("1", "L"):
        return image.convert("L")
    return image.convert("RGB")


def has_alpha(image: Image.Image) -> bool:
    return image.mode in ("RGBA", "LA", "PA", "La", "RGBa") or "transparency" in image.info


def _to_srgb(image: Image.Image, profile: bytes) -> Image.Image:
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        converted = ImageCms.profileToProfile(image, source, ImageCms.createProfile("sRGB"), outputMode="RGB")
    except (ImageCms.PyCMSError, OSError):  # a broken profile is as good as none
        converted = None
    return image.convert("RGB") if converted is None else converted


def bounded_profile(image: Image.Image) -> bytes | None:
    profile = image.info.get("icc_profile") or None
    if profile is not None and len(profile) > _MAX_PROFILE_BYTES:
        raise InvalidImage(f"An ICC profile of {len(profile)} bytes.", allowed=f"{_MAX_PROFILE_BYTES} bytes")
    return profile


def describes(profile: bytes | None, mode: str) -> bool:
    """Whether the colour space of an ICC profile (ICC.1:2022, bytes 16 to 19) is that of the samples."""
    return profile is not None and profile[16:20] == {**_PROFILE_SPACES, "CMYK": b"CMYK"}.get(mode)


def flat(picture: Image.Image) -> Image.Image:
    if picture.mode != "RGBA":
        return picture
    flat = Image.new("RGB", picture.size, _WHITE)
    flat.paste(picture, mask=picture.getchannel("A"))
    return flat
