"""Lens profiles of the lensfun project, through lensfunpy (extra ``[lensfun]``).

The request is JSON::

    {"camera_maker": "NIKON CORPORATION", "camera": "NIKON D3S", "lens": "Nikkor 28mm f/2.8D AF",
     "focal_length_mm": 28, "width": 4256, "height": 2832}

``camera_maker``, ``lens_maker``, ``aperture`` (8), ``distance_m`` (1000) and ``lens_xml``, a database of the caller's
own, are optional.
"""

from __future__ import annotations

from typing import Any

import orjson

from unbend_service.domain.dense_maps import PixelMap
from unbend_service.domain.errors import InvalidGrid, Unavailable

#: The map is smooth: it is asked for at about this size, and interpolated.
_LONGEST_PX = 1024


def read(body: bytes) -> PixelMap:
    """The correction that a profile describes.

    Raises:
        InvalidGrid: the request is incomplete, or no such profile is known.
        Unavailable: lensfunpy is not installed.
    """
    library = _lensfunpy()
    request = _request(body)
    database = library.Database(xml=request.get("lens_xml"))
    cameras = database.find_cameras(request.get("camera_maker"), request["camera"])
    if not cameras:
        raise InvalidGrid(f"No camera {request['camera']!r:.80} is known to lensfun.")
    lenses = database.find_lenses(cameras[0], request.get("lens_maker"), request["lens"])
    if not lenses:
        raise InvalidGrid(f"No lens {request['lens']!r:.80} for it is known to lensfun.")
    width, height = int(request["width"]), int(request["height"])
    shrink = min(1.0, _LONGEST_PX / max(width, height))
    map_width, map_height = max(2, round(width * shrink)), max(2, round(height * shrink))
    modifier = library.Modifier(lenses[0], cameras[0].crop_factor, map_width, map_height)
    modifier.initialize(
        float(request["focal_length_mm"]),
        float(request.get("aperture", 8.0)),
        float(request.get("distance_m", 1000.0)),
        scale=1.0,
        flags=library.ModifyFlags.DISTORTION | library.ModifyFlags.GEOMETRY,
    )
    coordinates = modifier.apply_geometry_distortion()
    if coordinates is None:
        raise InvalidGrid("The profile says nothing about distortion at this focal length.")
    return PixelMap(coordinates[..., 0], coordinates[..., 1])


def _request(body: bytes) -> dict[str, Any]:
    try:
        value = orjson.loads(body)
    except orjson.JSONDecodeError as error:
        raise InvalidGrid("The request for a lensfun profile is not JSON.") from error
    texts, numbers = ("camera", "lens"), ("focal_length_mm", "width", "height")
    complete = (
        isinstance(value, dict)
        and all(isinstance(value.get(name), str) for name in texts)
        and all(_positive(value.get(name)) for name in numbers)
        and all(isinstance(value.get(name, ""), str) for name in ("camera_maker", "lens_maker", "lens_xml"))
        and all(_positive(value.get(name, 1)) for name in ("aperture", "distance_m"))
    )
    if not complete:
        raise InvalidGrid(
            "The request for a lensfun profile is incomplete.",
            allowed="camera, lens, focal_length_mm, width, height; "
            "and camera_maker, lens_maker, aperture, distance_m, lens_xml",
        )
    return dict(value)


def _positive(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < 1e6


def _lensfunpy() -> Any:
    try:
        import lensfunpy
    except ImportError as error:
        raise Unavailable("lensfunpy is not installed here.", allowed="pip install 'unbend[lensfun]'") from error
    return lensfunpy
