from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from tests.fakes import RecordingMeter
from unbend_service.adapters.decoding.files import IsolatedFiles
from unbend_service.adapters.decoding.pool import DecoderPool
from unbend_service.adapters.exchange.files import ExchangeFiles
from unbend_service.domain.errors import InvalidGrid, UnbendError
from unbend_service.domain.exchange import DenseMap, ExportFormat, ImportFormat
from unbend_service.domain.maps import target_lattice
from unbend_service.settings import Settings

LOCAL = ExchangeFiles()
CAMERA = {
    "camera_matrix": [[500, 0, 320], [0, 500, 240], [0, 0, 1]],
    "dist_coeffs": [-0.2, 0.05, 0.001, 0.002, 0],
    "image_size": [640, 480],
}


@pytest.fixture(scope="module")
def isolated() -> Iterator[IsolatedFiles]:
    pool = DecoderPool(Settings(decoders=1), RecordingMeter())
    yield IsolatedFiles(pool)
    pool.close()


def dense() -> DenseMap:
    y, x = np.mgrid[0:48, 0:64].astype(np.float32)
    return DenseMap(x + np.float32(0.4), y * np.float32(0.9))


def written(kind: ExportFormat) -> bytes:
    return LOCAL.write_map(kind, dense()).body


BODIES: dict[str, tuple[ImportFormat, bytes]] = {
    "npz": (ImportFormat.NPZ, written(ExportFormat.NPZ)),
    "npz fixed": (ImportFormat.NPZ, written(ExportFormat.NPZ_FIXED)),
    "tiff": (ImportFormat.STMAP_TIFF, written(ExportFormat.STMAP_TIFF)),
    "opencv": (ImportFormat.OPENCV, json.dumps(CAMERA).encode()),
    "npz cut off": (ImportFormat.NPZ, written(ExportFormat.NPZ)[:500]),
    "tiff cut off": (ImportFormat.STMAP_TIFF, written(ExportFormat.STMAP_TIFF)[:500]),
    "yaml": (ImportFormat.OPENCV, b"%YAML:1.0\n---\ncamera_matrix: [ 1, 2"),
    "no camera": (ImportFormat.OPENCV, b"{}"),
    "empty": (ImportFormat.STMAP_TIFF, b""),
}


def outcome(files: ExchangeFiles, kind: ImportFormat, body: bytes) -> Any:
    try:
        return files.read_map(kind, body)(target_lattice(9, 9)).tolist()
    except UnbendError as error:
        return type(error), error.allowed


@pytest.mark.parametrize("name", BODIES)
def test_both_read_the_same(isolated: IsolatedFiles, name: str) -> None:
    """Maps, cameras and refusals come from the other process as they would come from this one."""
    kind, body = BODIES[name]
    assert outcome(isolated, kind, body) == outcome(LOCAL, kind, body)


def test_an_archive_that_unpacks_to_gigabytes_is_refused(isolated: IsolatedFiles) -> None:
    """By its header, before it is unpacked."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": (90_000, 90_000)})
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name in ("map_x.npy", "map_y.npy"):
            archive.writestr(name, header.getvalue())
    with pytest.raises(InvalidGrid, match="too large"):
        isolated.read_map(ImportFormat.NPZ, out.getvalue())
