"""A correction in a notebook: before and after, side by side, as HTML that needs nothing from elsewhere."""

from __future__ import annotations

import base64
import html
import struct
import zlib

import numpy as np
import numpy.typing as npt

from unbend._colours import read_rgb

Bytes = npt.NDArray[np.uint8]

#: Longest side of an array as it is shown, pixels.
_SHOWN_PX = 720
#: A larger file is named and not shown: a notebook keeps every byte of what it shows.
_SHOWN_BYTES = 8 << 20
_TYPES = ((b"\xff\xd8\xff", "jpeg"), (b"\x89PNG", "png"), (b"RIFF", "webp"), (b"GIF8", "gif"))


def draw_comparison(before: Bytes | bytes | None, after: Bytes | bytes, pixel_format: str, caption: str) -> str:
    """HTML of both pictures and a caption.

    Args:
        before, after: arrays that hold raw frames of ``pixel_format``, shaped as they were sent, or files.
    """
    figures = [
        _figure(picture, pixel_format, title)
        for picture, title in ((before, "before"), (after, "after"))
        if picture is not None
    ]
    return (
        '<div style="display:flex;flex-wrap:wrap;gap:8px">'
        + "".join(figures)
        + f'</div><div style="font-size:90%">{html.escape(caption)}</div>'
    )


def encode_png(image: Bytes) -> bytes:
    """(height, width, 3) uint8 RGB as a PNG file."""
    height, width = image.shape[:2]
    rows = np.zeros((height, 1 + 3 * width), np.uint8)
    rows[:, 0] = 2  # every row is stored as its difference to the one above
    flat = image.reshape(height, -1)
    rows[:, 1:] = flat
    rows[1:, 1:] -= flat[:-1]
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = ((b"IHDR", header), (b"IDAT", zlib.compress(rows.tobytes(), 6)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(kind, data) for kind, data in parts)


def shrink(image: Bytes, longest_px: int = _SHOWN_PX) -> Bytes:
    """(height, width, 3) uint8, by the smallest whole factor that fits, each pixel the mean of its block."""
    height, width = image.shape[:2]
    factor = -(-max(height, width) // longest_px)
    if factor <= 1 or min(height, width) < factor:
        return image
    high, wide = height // factor, width // factor
    blocks = image[: high * factor, : wide * factor].reshape(high, factor, wide, factor, 3)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float32).round(), dtype=np.uint8)


def _figure(picture: Bytes | bytes, pixel_format: str, title: str) -> str:
    source = _data_uri(picture, pixel_format)
    style = f"max-width:min(100%,{_SHOWN_PX}px)"
    shown = f'<img alt="{title}" style="{style}" src="{source}">' if source else "<em>too large to be shown here</em>"
    return f'<figure style="margin:0;flex:1 1 240px">{shown}<figcaption>{title}</figcaption></figure>'


def _data_uri(picture: Bytes | bytes, pixel_format: str) -> str:
    """Empty for a file that is too large, or that browsers do not show."""
    if isinstance(picture, bytes):
        kind = next((name for magic, name in _TYPES if picture.startswith(magic)), "")
        body = picture if len(picture) <= _SHOWN_BYTES else b""
    else:
        height, width = picture.shape[:2]
        if pixel_format in ("i420", "nv12"):
            height = height * 2 // 3
        kind, body = "png", encode_png(shrink(read_rgb(picture, pixel_format, width, height)))
    return f"data:image/{kind};base64,{base64.b64encode(body).decode()}" if kind and body else ""


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
