"""Which camera and lens took a picture, as its EXIF block names them."""

from __future__ import annotations

import hashlib
import re

from PIL import Image

_MAKE, _MODEL, _EXIF_IFD = 0x010F, 0x0110, 0x8769
_FOCAL_LENGTH, _LENS_MODEL, _DIGITAL_ZOOM = 0x920A, 0xA434, 0xA404
_LONGEST_NAME = 96


def camera_name(exif: bytes, width: int, height: int) -> str | None:
    """A name for the camera, lens, focal length and proportions; None if the block does not say enough.

    Args:
        exif: the block, with or without its ``Exif`` mark.
        width, height: of the upright picture: a cropped or turned picture shows another part of the lens.
    """
    tags = Image.Exif()
    try:
        tags.load(exif)
        details = tags.get_ifd(_EXIF_IFD)
        focal_mm = float(details[_FOCAL_LENGTH])
        zoom = float(details.get(_DIGITAL_ZOOM) or 1.0) or 1.0
    except (KeyError, TypeError, ValueError, ZeroDivisionError, OSError, SyntaxError, OverflowError):
        return None
    make, model, lens = (_plain(tag) for tag in (tags.get(_MAKE), tags.get(_MODEL), details.get(_LENS_MODEL)))
    if not (make and model) or not 0 < focal_mm < 10_000:
        return None
    name = f"exif:{make}:{model}:{lens}:{focal_mm:.4g}mm:{zoom:.3g}x:{width / height:.3f}"
    if len(name) > _LONGEST_NAME:
        name = f"exif:{hashlib.blake2b(name.encode(), digest_size=16).hexdigest()}"
    return name


def _plain(value: object) -> str:
    return re.sub(r"[^A-Za-z0-9.]+", "-", str(value or "")).strip("-")
