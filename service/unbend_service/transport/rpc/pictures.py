"""Bounds on the pictures of unary calls."""

from __future__ import annotations

from unbend_service.domain.errors import BodyTooLarge, TooManyPixels


def check_body(data: bytes, body_bytes: int) -> bytes:
    """An encoded picture that is not too large. Raises BodyTooLarge."""
    if len(data) > body_bytes:
        raise BodyTooLarge(f"A picture of {len(data)} bytes.", allowed=f"{body_bytes} bytes", setting="body_bytes")
    return data


def check_pixels(width: int, height: int, source_pixels: int) -> None:
    """The size of a raw picture. Raises TooManyPixels."""
    if width * height > source_pixels:
        raise TooManyPixels(
            f"A picture of {width}x{height} pixels.", allowed=f"{source_pixels} pixels", setting="source_pixels"
        )
