"""The two maps of ffmpeg's remap filter, with the command line that uses them.

The filter's maps are 16-bit whole numbers: it takes the nearest pixel and never looks between pixels. The maps
therefore address a picture enlarged ``OVERSAMPLING`` times, which the command line makes with the bilinear scaler
first, so a sample is off by an eighth of a pixel at most.
"""

from __future__ import annotations

import io
import zipfile

import numpy as np

from unbend_service.domain.errors import InvalidOption
from unbend_service.domain.exchange import DenseMap
from unbend_service.domain.grid import Float32

OVERSAMPLING = 4
#: A coordinate outside of every picture: the filter paints its fill colour there.
_NOWHERE = 65535
_LONGEST_PX = (_NOWHERE - 1) // OVERSAMPLING
#: A source so little outside still counts as inside.
_EDGE_PX = 1 / 64

_README = """Unbend's map for ffmpeg, {width}x{height}

    ffmpeg -i IN -i xmap.pgm -i ymap.pgm -filter_complex \\
      "{graph}" \\
      -map "[straight]" -map 0:a? -c:a copy OUT

IN must be {width}x{height}. ffmpeg's remap filter knows whole pixels only (nearest neighbour), so the picture is
enlarged {oversampling} times before it is sampled, in full chroma resolution. That costs memory and time; for speed
without quality export the OpenCV maps, or let `unbend video` do the work. Pixels without a source are black; the
option fill of remap takes another colour.
"""


def filter_graph() -> str:
    """The ffmpeg filter graph from input 0 and the maps as inputs 1 and 2 to [straight]."""
    return (
        f"[0:v]format=yuv444p,scale={OVERSAMPLING}*iw:{OVERSAMPLING}*ih:flags=bilinear[large];"
        "[large][1:v][2:v]remap,format=yuv420p[straight]"
    )


def write_zip(dense: DenseMap) -> bytes:
    """``xmap.pgm``, ``ymap.pgm`` and ``README.txt``.

    Raises:
        InvalidOption: a side too long for 16-bit coordinates.
    """
    if max(dense.width, dense.height) > _LONGEST_PX:
        raise InvalidOption("The picture is too large for ffmpeg's maps.", allowed=f"sides up to {_LONGEST_PX} pixels")
    outside = _outside(dense.map_x, dense.width) | _outside(dense.map_y, dense.height)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, samples, length in (("xmap.pgm", dense.map_x, dense.width), ("ymap.pgm", dense.map_y, dense.height)):
            enlarged = np.rint((samples + 0.5) * OVERSAMPLING - 0.5).clip(0, OVERSAMPLING * length - 1)
            enlarged[outside] = _NOWHERE
            header = f"P5\n{dense.width} {dense.height}\n65535\n".encode()
            archive.writestr(name, header + enlarged.astype(">u2").tobytes())
        text = _README.format(width=dense.width, height=dense.height, graph=filter_graph(), oversampling=OVERSAMPLING)
        archive.writestr("README.txt", text)
    return out.getvalue()


def _outside(samples: Float32, length: int) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    return np.asarray((samples < -0.5 - _EDGE_PX) | (samples > length - 0.5 + _EDGE_PX))
