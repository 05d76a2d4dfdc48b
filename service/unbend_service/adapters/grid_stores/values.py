"""Grids as bytes that say of which make they are, and that cannot be taken for another grid."""

from __future__ import annotations

import dataclasses

import numpy as np
import orjson

from unbend_service.domain.errors import InvalidInput
from unbend_service.domain.grid import Grid
from unbend_service.domain.records import GridRecord

#: Goes up when older replicas could not read what newer ones write.
VALUE_VERSION = 1


class Unreadable(ValueError):
    """Bytes of another make, damaged, or of another grid."""


def pack(record: GridRecord) -> bytes:
    """A line of JSON (version, provenance, size), then the lattice: (rows, columns, 2) little-endian float32."""
    size = {"rows": record.grid.rows, "columns": record.grid.columns}
    head = {**record.provenance(), "grid": size, "version": VALUE_VERSION}
    return orjson.dumps(head) + b"\n" + record.grid.source.astype("<f4").tobytes()


def unpack(grid_id: str, value: bytes) -> GridRecord:
    """Inverse of :func:`pack`. The id is computed from the lattice again.

    Raises:
        Unreadable: the bytes are not those of ``grid_id``, or not of this version.
    """
    try:
        line, source = value.split(b"\n", 1)
        head = orjson.loads(line)
        if head["version"] != VALUE_VERSION:
            raise Unreadable(f"version {head['version']!r:.20}")
        lattice = np.frombuffer(source, dtype="<f4").reshape(head["grid"]["rows"], head["grid"]["columns"], 2)
        record = GridRecord.from_dict({**head, "grid": Grid.identity(2, 2).to_dict()})
        record = dataclasses.replace(record, grid=Grid(lattice))
    except Unreadable:
        raise
    except (InvalidInput, ValueError, KeyError, TypeError) as error:
        raise Unreadable("damaged") from error
    if record.id != grid_id:
        raise Unreadable(f"the grid {record.id}")
    return record
