"""The table of formats."""

from __future__ import annotations

from collections.abc import Callable

import orjson

from unbend_service.adapters.exchange import ffmpeg, lensfun, maps_npz, opencv_cameras, stmaps
from unbend_service.application.record_json import record_json
from unbend_service.domain.decision import spin_grid
from unbend_service.domain.errors import InvalidGrid
from unbend_service.domain.exchange import DenseMap, ExportedFile, ExportFormat, ImportFormat
from unbend_service.domain.guides import Guides
from unbend_service.domain.maps import BackwardMap
from unbend_service.domain.records import Correct, GridRecord

_WRITERS: dict[ExportFormat, tuple[Callable[[DenseMap], bytes], str, str]] = {
    ExportFormat.NPZ: (maps_npz.write_float, "application/zip", ".npz"),
    ExportFormat.NPZ_FIXED: (maps_npz.write_fixed, "application/zip", ".npz"),
    ExportFormat.STMAP_EXR: (stmaps.write_exr, "image/x-exr", ".exr"),
    ExportFormat.STMAP_TIFF: (stmaps.write_tiff, "image/tiff", ".tiff"),
    ExportFormat.FFMPEG: (ffmpeg.write_zip, "application/zip", ".zip"),
}
_READERS: dict[ImportFormat, Callable[[bytes], BackwardMap]] = {
    ImportFormat.NPZ: maps_npz.read,
    ImportFormat.STMAP_EXR: stmaps.read_exr,
    ImportFormat.STMAP_TIFF: stmaps.read_tiff,
    ImportFormat.OPENCV: opencv_cameras.read,
    ImportFormat.LENSFUN: lensfun.read,
}


class ExchangeFiles:
    """Port GridFiles. Stateless."""

    def write_record(self, record: GridRecord) -> ExportedFile:
        return ExportedFile(record_json(record), "application/json", ".json")

    def read_record(self, body: bytes) -> GridRecord:
        try:
            value = orjson.loads(body)
        except orjson.JSONDecodeError as error:
            raise InvalidGrid(f"The grid is not JSON: {error}.", allowed="RFC 8259 JSON") from error
        if isinstance(value, dict) and value.get("grid") is None and value.get("guides") is not None:
            guides = Guides.from_dict(value["guides"])
            record = GridRecord(spin_grid(guides, Correct.ALL), guides)
        else:
            record = GridRecord.from_dict(value)
        record.grid.check_unfolded()
        return record

    def write_map(self, kind: ExportFormat, dense: DenseMap) -> ExportedFile:
        write, media_type, suffix = _WRITERS[kind]
        return ExportedFile(write(dense), media_type, suffix)

    def read_map(self, kind: ImportFormat, body: bytes) -> BackwardMap:
        return _READERS[kind](body)
