"""Good inputs, which mutations start from."""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
from PIL import Image, ImageCms

from unbend.v1 import correction_pb2, estimation_pb2, frame_pb2, grid_pb2
from unbend_service.adapters.exchange.files import ExchangeFiles
from unbend_service.domain.exchange import DenseMap, ExportFormat
from unbend_service.domain.grid import Grid
from unbend_service.domain.guides import Guides

ROWS = 5
GRID = Grid.identity(ROWS, ROWS)


def picture(mode: str = "RGB", width: int = 48, height: int = 32) -> Image.Image:
    y, x = np.mgrid[0:height, 0:width]
    channels = [(x * 5) % 256, (y * 7) % 256, (x * y) % 256]
    return Image.fromarray(np.stack(channels, -1).astype(np.uint8)).convert(mode)


def _encoded(image: Image.Image, image_format: str, **options: Any) -> bytes:
    out = io.BytesIO()
    image.save(out, image_format, **options)
    return out.getvalue()


def _exif() -> bytes:
    block = Image.Exif()
    block[0x0112], block[0x010F] = 6, "A maker"
    return block.tobytes()


def pictures() -> list[bytes]:
    """jpeg, png, webp, tiff and bmp of many kinds."""
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    deep = Image.fromarray(np.arange(48 * 32, dtype=np.uint16).reshape(32, 48))
    bodies = [
        _encoded(picture(), "jpeg"),
        _encoded(picture(), "jpeg", progressive=True, exif=_exif(), icc_profile=profile),
        _encoded(picture("CMYK"), "jpeg"),
        _encoded(picture("L"), "jpeg", restart_marker_rows=1),
        _encoded(picture(), "png"),
        _encoded(picture("RGBA"), "png", exif=_exif(), icc_profile=profile),
        _encoded(picture().quantize(), "png", transparency=3),
        _encoded(deep, "png"),
        _encoded(picture("1"), "png"),
        _encoded(picture(), "webp"),
        _encoded(picture("RGBA"), "webp", lossless=True, exif=_exif()),
        _encoded(picture(), "webp", save_all=True, append_images=[picture("L")]),
        _encoded(picture(), "bmp"),
        _encoded(picture().quantize(), "bmp"),
    ]
    bodies += [_encoded(picture(), "tiff", compression=kind) for kind in ("raw", "tiff_lzw", "jpeg", "packbits")]
    bodies += [
        _encoded(deep, "tiff", compression="tiff_adobe_deflate"),
        _encoded(picture("1"), "tiff", compression="group4"),
    ]
    return bodies


def grids() -> list[bytes]:
    """JSON as /v1/grids takes it."""
    straight = Guides.straight()
    return [
        json.dumps({"grid": GRID.to_dict()}).encode(),
        json.dumps({"guides": straight.to_dict()}).encode(),
        json.dumps(
            {"grid": GRID.to_dict(), "guides": straight.to_dict(), "confidence": 0.5, "strength": 1, "model": "m"}
        ).encode(),
    ]


def imports() -> dict[str, bytes]:
    """A file for each import format."""
    y, x = np.mgrid[0:9, 0:12].astype(np.float32)
    files, dense = ExchangeFiles(), DenseMap(x, y)
    camera = {
        "camera_matrix": [[50, 0, 6], [0, 50, 4], [0, 0, 1]],
        "dist_coeffs": [0.1, 0, 0, 0],
        "image_size": [12, 9],
    }
    lens = {"camera": "NIKON D3S", "lens": "Nikkor 28mm f/2.8D AF", "focal_length_mm": 28, "width": 64, "height": 48}
    return {
        "json": grids()[0],
        "npz": files.write_map(ExportFormat.NPZ, dense).body,
        "stmap-tiff": files.write_map(ExportFormat.STMAP_TIFF, dense).body,
        "stmap-exr": files.write_map(ExportFormat.STMAP_EXR, dense).body,
        "opencv": json.dumps(camera).encode(),
        "lensfun": json.dumps(lens).encode(),
    }


def messages(picture_bodies: list[bytes]) -> dict[str, list[bytes]]:
    """Serialized requests by method; of the stream, its messages one by one."""
    raw = frame_pb2.FrameFormat(pixel_format=frame_pb2.PIXEL_FORMAT_RGB24, width=8, height=6)
    jpeg = frame_pb2.FrameFormat(pixel_format=frame_pb2.PIXEL_FORMAT_JPEG)
    rendering = frame_pb2.Rendering(fit="keep", strength=0.5, border=frame_pb2.Border(red=1, alpha=255), quality=80)
    lattice = grid_pb2.Grid(rows=ROWS, columns=ROWS, source=GRID.source.ravel().tolist())
    rows = [grid_pb2.Guide(anchor=anchor, coefficients=[anchor, 0, 0, 0]) for anchor in (-0.5, 0.5)]
    guides = grid_pb2.Guides(rows=rows, columns=rows)
    correction, frame = "/unbend.v1.CorrectionService/", correction_pb2.CorrectStreamRequest
    opened = [
        correction_pb2.StreamOpen(format=raw, grid_id=GRID.id, rendering=rendering),
        correction_pb2.StreamOpen(format=jpeg, guides=guides, stream_id="fuzz"),
        correction_pb2.StreamOpen(format=raw, estimate=correction_pb2.EstimateFrames(frames=1), estimate_again=True),
    ]
    requests: dict[str, list[Any]] = {
        "/unbend.v1.EstimationService/Estimate": [
            estimation_pb2.EstimateRequest(format=raw, data=bytes(144), fit="keep", strength=1),
            estimation_pb2.EstimateRequest(format=jpeg, data=picture_bodies[0], min_confidence=0.1),
        ],
        correction + "Correct": [
            correction_pb2.CorrectRequest(format=raw, data=bytes(144), grid_id=GRID.id, rendering=rendering),
            *(
                correction_pb2.CorrectRequest(format=jpeg, data=body, grid_id=GRID.id, rendering=rendering)
                for body in picture_bodies
            ),
        ],
        correction + "CorrectStream": [
            *(frame(open=each) for each in opened),
            frame(frame=correction_pb2.StreamFrame(index=0, timestamp_us=1, data=bytes(144))),
            frame(frame=correction_pb2.StreamFrame(index=0, data=picture_bodies[0])),
        ],
        "/unbend.v1.GridService/GetGrid": [grid_pb2.GetGridRequest(grid_id=GRID.id)],
        "/unbend.v1.GridService/PutGrid": [
            grid_pb2.PutGridRequest(grid=lattice),
            grid_pb2.PutGridRequest(guides=guides),
        ],
        "/unbend.v1.GridService/DeleteGrid": [grid_pb2.DeleteGridRequest(grid_id="g0")],
        "/grpc.health.v1.Health/Check": [],
        "/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo": [],
    }
    serialized = {method: [each.SerializeToString() for each in some] for method, some in requests.items()}
    serialized["/grpc.health.v1.Health/Check"] = [b"\x0a\x03abc"]
    serialized["/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo"] = [
        b"\x1a\x05a.b.c", b"\x22\x16unbend.v1.GridService", b"\x2a\x04\x0a\x02ab", b"\x32\x02ab", b"\x3a\x00",
    ]  # fmt: skip
    return serialized
