"""GridFiles whose reading of foreign files happens elsewhere."""

from __future__ import annotations

from typing import Any

import numpy as np

from unbend_service.adapters.decoding.pool import DecoderPool
from unbend_service.adapters.exchange.files import ExchangeFiles
from unbend_service.domain.cameras import Camera
from unbend_service.domain.dense_maps import PixelMap
from unbend_service.domain.errors import InvalidGrid, InvalidImage
from unbend_service.domain.exchange import ImportFormat
from unbend_service.domain.maps import BackwardMap


class IsolatedFiles(ExchangeFiles):
    """Port GridFiles: archives, pictures and calibrations are read in the processes of a pool.

    Records are JSON and read here; what is written is our own.
    """

    def __init__(self, pool: DecoderPool) -> None:
        self._pool = pool

    def read_map(self, kind: ImportFormat, body: bytes) -> BackwardMap:
        """See GridFiles; raises ImageTooCostly and MemoryFull too."""
        try:
            verdict = self._pool.work("map", body or b"\0", kind=kind.value)
        except InvalidImage as error:
            raise InvalidGrid(error.message) from error
        fields = verdict.fields
        width, height = fields.get("width"), fields.get("height")
        if type(width) is not int or type(height) is not int:
            raise _nonsense()
        if "camera" in fields:
            return _camera(fields, width, height)
        if len(verdict.parts) != 1 or min(width, height) < 1 or verdict.parts[0].size != 8 * width * height:
            raise _nonsense()
        # read once: the decoder could still write there while it is checked
        map_x, map_y = verdict.parts[0].copy().view(np.float32).reshape(2, height, width)
        return PixelMap(map_x, map_y)


def _camera(fields: dict[str, Any], width: int, height: int) -> Camera:
    numbers = fields["camera"]
    if not isinstance(numbers, list) or len(numbers) < 9 or not all(isinstance(n, int | float) for n in numbers):
        raise _nonsense()
    matrix = np.array(numbers[:9], dtype=np.float64).reshape(3, 3)
    return Camera(matrix, tuple(float(n) for n in numbers[9:]), fields.get("fisheye") is True, width, height)


def _nonsense() -> InvalidGrid:
    return InvalidGrid("The decoder gave no sensible answer to this file.")
