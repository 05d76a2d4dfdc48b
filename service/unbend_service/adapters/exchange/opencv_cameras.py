"""Camera matrix and distortion coefficients, as cv2.FileStorage or ROS write them, or as plain JSON.

Looked for, in this order: ``camera_matrix``, ``cameraMatrix``, ``K``, ``mtx``; ``distortion_coefficients``,
``dist_coeffs``, ``distCoeffs``, ``D``, ``dist``; ``image_size`` [width, height], ``image_width`` and ``image_height``,
or ``width`` and ``height``. ``distortion_model`` or ``model`` names ``fisheye``, ``equidistant`` or
``kannala_brandt4`` for the fisheye model; ``plumb_bob``, ``rational_polynomial`` and anything else, or nothing, is the
pinhole model.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import orjson

from unbend_service.domain.cameras import Camera
from unbend_service.domain.errors import InvalidGrid
from unbend_service.domain.maps import Float64

_MATRICES = ("camera_matrix", "cameraMatrix", "K", "mtx")
_COEFFICIENTS = ("distortion_coefficients", "dist_coeffs", "distCoeffs", "D", "dist")
_MODELS = ("distortion_model", "model")
_FISHEYES = ("fisheye", "equidistant", "kannala_brandt", "kannala_brandt4", "kb4")
_LARGEST_BYTES = 1 << 20
_DEEPEST = 6
_MOST_ITEMS = 4096


def read(body: bytes) -> Camera:
    """The camera of a JSON or YAML file. Raises InvalidGrid."""
    if len(body) > _LARGEST_BYTES:
        raise InvalidGrid("The calibration file is too large.", allowed=f"{_LARGEST_BYTES} bytes")
    fields = _parsed(body)
    matrix = _numbers(_first(fields, _MATRICES))
    coefficients = _numbers(_first(fields, _COEFFICIENTS)).reshape(-1)
    if matrix.size != 9:
        raise InvalidGrid(f"The camera matrix has {matrix.size} numbers.", allowed="9")
    width, height = _size(fields)
    model = next((fields[name] for name in _MODELS if isinstance(fields.get(name), str)), "pinhole")
    fisheye = str(model).lower() in _FISHEYES
    return Camera(matrix.reshape(3, 3), tuple(coefficients.tolist()), fisheye, width, height)


def _parsed(body: bytes) -> dict[str, Any]:
    try:
        value = orjson.loads(body)
    except orjson.JSONDecodeError:
        value = _yaml(body)
    if not isinstance(value, dict):
        raise InvalidGrid("The calibration file is not an object.", allowed="JSON or YAML with camera_matrix")
    return value


def _yaml(body: bytes) -> Any:
    try:
        text = body.decode()
        if not text.lstrip().startswith("%YAML"):
            text = "%YAML:1.0\n" + ("" if text.lstrip().startswith("---") else "---\n") + text
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        try:
            return _plain(storage.root())
        finally:
            storage.release()
    except (UnicodeDecodeError, cv2.error, SystemError) as error:
        raise InvalidGrid("The calibration file is neither JSON nor YAML.", allowed="JSON or YAML") from error


def _plain(node: cv2.FileNode, depth: int = 0) -> Any:
    """Nodes as dictionaries, lists, numbers and texts."""
    if depth > _DEEPEST or node.size() > _MOST_ITEMS:
        raise InvalidGrid("The calibration file is too deep or too long.")
    if node.isMap():
        return {name: _plain(node.getNode(name), depth + 1) for name in node.keys()}  # noqa: SIM118  # not a dict
    if node.isSeq():
        return [_plain(node.at(i), depth + 1) for i in range(node.size())]
    if node.isInt() or node.isReal():
        return node.real()
    return node.string() if node.isString() else None


def _first(fields: dict[str, Any], names: tuple[str, ...]) -> Any:
    for name in names:
        if fields.get(name) is not None:
            return fields[name]
    raise InvalidGrid(f"The calibration file has no {names[0]}.", allowed=" or ".join(names))


def _numbers(value: Any) -> Float64:
    """Of nested lists, or of a matrix object with its ``data``."""
    if isinstance(value, dict):
        value = value.get("data")
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidGrid("A matrix of the calibration file is not made of numbers.") from error


def _size(fields: dict[str, Any]) -> tuple[int, int]:
    size = fields.get("image_size")
    if not (isinstance(size, list) and len(size) == 2):
        size = [fields.get("image_width", fields.get("width")), fields.get("image_height", fields.get("height"))]
    try:
        return int(size[0]), int(size[1])
    except (TypeError, ValueError, OverflowError) as error:
        raise InvalidGrid(
            "The calibration file does not say the size of its pictures.", allowed="image_width and image_height"
        ) from error
