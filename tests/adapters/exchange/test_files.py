"""Each export is run by the program that it is for."""

from __future__ import annotations

import io
import shutil
import subprocess
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import orjson
import pytest

from tests.domain.lenses import BARREL, radial
from tests.fakes import draw_through
from unbend_service.adapters.exchange.ffmpeg import filter_graph
from unbend_service.adapters.exchange.files import ExchangeFiles
from unbend_service.domain.dense_maps import inverse_pixel_maps, pixel_maps
from unbend_service.domain.errors import InvalidGrid, InvalidOption
from unbend_service.domain.exchange import DenseMap, ExportFormat, ImportFormat
from unbend_service.domain.fit import CROP, with_fit
from unbend_service.domain.frames import BLACK, Frame, PixelFormat
from unbend_service.domain.grid import Grid
from unbend_service.domain.records import GridRecord

WIDTH, HEIGHT = 320, 240
GRID = with_fit(Grid.from_map(radial(BARREL)), CROP)
FILES = ExchangeFiles()
DENSE = DenseMap(*pixel_maps(GRID, WIDTH, HEIGHT))
MAPS = [ExportFormat.NPZ, ExportFormat.NPZ_FIXED, ExportFormat.STMAP_EXR, ExportFormat.STMAP_TIFF]


def picture() -> np.ndarray:
    """As smooth as a photograph at this size: blurred noise over a few scales, (HEIGHT, WIDTH, 3) uint8."""
    random = np.random.default_rng(3)
    total = np.zeros((HEIGHT, WIDTH, 3))
    for sigma, share in ((2.5, 25), (6, 60), (24, 300)):
        total += share * cv2.GaussianBlur(random.normal(size=(HEIGHT, WIDTH, 3)), (0, 0), sigma) * sigma
    return np.clip(128 + total * 0.5, 0, 255).astype(np.uint8)


def ours() -> np.ndarray:
    """What the renderer draws through the grid."""
    frame = Frame(PixelFormat.RGB24, WIDTH, HEIGHT, picture().reshape(-1))
    return draw_through(frame, GRID, BLACK).reshape(HEIGHT, WIDTH, 3)


def psnr_db(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.maximum(((a.astype(float) - b) ** 2).mean(), 1e-9)))


def read_as(kind: ExportFormat) -> ImportFormat:
    return ImportFormat.NPZ if kind is ExportFormat.NPZ_FIXED else ImportFormat(kind.value)


def test_the_picture_is_no_easy_one() -> None:
    """It has detail, and the lens moves it: without a map the other tools would be far off."""
    assert picture().std() > 30
    assert psnr_db(picture(), ours()) < 25


@pytest.mark.parametrize(
    ("kind", "names"),
    [(ExportFormat.NPZ, ("map_x", "map_y")), (ExportFormat.NPZ_FIXED, ("map_1", "map_2"))],
)
def test_opencv_draws_our_picture(kind: ExportFormat, names: tuple[str, str]) -> None:
    """cv2.remap takes the arrays as they are and gives what the renderer gives: 40 dB and more."""
    archive: Any = np.load(io.BytesIO(FILES.write_map(kind, DENSE).body))
    drawn = cv2.remap(picture(), archive[names[0]], archive[names[1]], cv2.INTER_LINEAR)
    assert psnr_db(drawn, ours()) >= 40


def test_a_stmap_is_read_by_openexr_in_the_convention_of_nuke(tmp_path: Path) -> None:
    """Red is u, green is v upwards, both 0..1 with pixel centres at (i + 0.5) / n, and blue masks the source."""
    library = pytest.importorskip("OpenEXR", reason="the extra [export] is not installed")
    path = tmp_path / "stmap.exr"
    path.write_bytes(FILES.write_map(ExportFormat.STMAP_EXR, DenseMap(*pixel_maps(Grid.identity(), 8, 4))).body)
    with library.File(str(path)) as file:
        pixels = file.channels()["RGB"].pixels
    assert pixels.dtype == np.float32
    np.testing.assert_allclose(pixels[..., 0], np.tile((np.arange(8) + 0.5) / 8, (4, 1)), atol=1e-6)
    np.testing.assert_allclose(pixels[..., 1], np.tile(1 - (np.arange(4)[:, None] + 0.5) / 4, (1, 8)), atol=1e-6)
    assert (pixels[..., 2] == 1).all()


def test_a_stmap_as_tiff_holds_the_same_numbers() -> None:
    """tifffile finds RGB in 32-bit float, equal to the numbers of the EXR."""
    tifffile = pytest.importorskip("tifffile")
    pixels = tifffile.imread(io.BytesIO(FILES.write_map(ExportFormat.STMAP_TIFF, DENSE).body))
    assert pixels.shape == (HEIGHT, WIDTH, 3)
    assert pixels.dtype == np.float32
    np.testing.assert_allclose(pixels[..., 0] * WIDTH - 0.5, DENSE.map_x, atol=1e-3)
    np.testing.assert_allclose((1 - pixels[..., 1]) * HEIGHT - 0.5, DENSE.map_y, atol=1e-3)


def test_a_stmap_draws_our_picture_the_way_a_compositor_does() -> None:
    """Sampled bilinearly at (u W, v H), v from the bottom, the picture is ours."""
    pixels = cv2.imdecode(np.frombuffer(FILES.write_map(ExportFormat.STMAP_TIFF, DENSE).body, np.uint8), -1)
    u, v = pixels[..., 2], pixels[..., 1]
    upside_down = picture()[::-1]
    drawn = cv2.remap(upside_down, u * WIDTH - np.float32(0.5), v * HEIGHT - np.float32(0.5), cv2.INTER_LINEAR)
    assert psnr_db(drawn, ours()) >= 40


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="ffmpeg is not installed")
def test_ffmpeg_draws_our_picture_with_the_command_line_of_its_readme(tmp_path: Path) -> None:
    """The remap filter, with the graph that the zip names, gives our picture to 40 dB and more."""
    with zipfile.ZipFile(io.BytesIO(FILES.write_map(ExportFormat.FFMPEG, DENSE).body)) as archive:
        archive.extractall(tmp_path)
    text = (tmp_path / "README.txt").read_text()
    assert filter_graph() in text
    cv2.imwrite(str(tmp_path / "in.png"), picture()[..., ::-1])
    # the graph ends in yuv420p for video; the comparison is of the mapping, so the answer keeps its chroma
    graph = filter_graph().replace("format=yuv420p", "format=rgb24")
    command = ["ffmpeg", "-v", "error", "-i", "in.png", "-i", "xmap.pgm", "-i", "ymap.pgm"]
    command += ["-filter_complex", graph, "-map", "[straight]", "out.png"]
    subprocess.run(command, cwd=tmp_path, check=True, timeout=60)
    drawn = cv2.imread(str(tmp_path / "out.png"))[..., ::-1]
    assert psnr_db(drawn, ours()) >= 40


def test_pixels_without_a_source_are_out_of_reach_of_ffmpeg() -> None:
    """They point past the enlarged picture, where the filter paints its fill colour."""
    shrunk = DenseMap(*pixel_maps(Grid(Grid.identity(9, 9).source * 1.5), 64, 48))
    with zipfile.ZipFile(io.BytesIO(FILES.write_map(ExportFormat.FFMPEG, shrunk).body)) as archive:
        samples = np.frombuffer(archive.read("xmap.pgm")[-64 * 48 * 2 :], ">u2").reshape(48, 64)
    assert samples[0, 0] == 65535
    assert samples[24, 32] < 4 * 64


@pytest.mark.parametrize("kind", MAPS, ids=str)
def test_what_was_exported_comes_back(kind: ExportFormat) -> None:
    """Written and read again, a grid is the same to within a fiftieth of a pixel (fixed point: its own step)."""
    if kind is ExportFormat.STMAP_EXR:
        pytest.importorskip("OpenEXR", reason="the extra [export] is not installed")
    read = Grid.from_map(FILES.read_map(read_as(kind), FILES.write_map(kind, DENSE).body), 65, 65)
    bound_px = 1 / 16 if kind is ExportFormat.NPZ_FIXED else 0.02
    offset = (read.source - GRID.source)[1:-1, 1:-1]
    assert np.abs(offset * [WIDTH / 2, HEIGHT / 2]).max() < bound_px


def test_a_redistortion_undoes_the_picture() -> None:
    """Drawn straight with one map and bent again with the other, the middle of the picture is what it was."""
    straight = cv2.remap(picture(), DENSE.map_x, DENSE.map_y, cv2.INTER_CUBIC)
    back = DenseMap(*inverse_pixel_maps(GRID, WIDTH, HEIGHT))
    bent = cv2.remap(straight, back.map_x, back.map_y, cv2.INTER_CUBIC)
    middle = slice(60, 180), slice(80, 240)
    assert psnr_db(bent[middle], picture()[middle]) >= 40


def test_a_record_is_read_as_it_was_written() -> None:
    record = GridRecord(GRID, confidence=0.5, model="first")
    assert FILES.read_record(FILES.write_record(record).body).to_dict() == record.to_dict()


K = np.array([[410.0, 0, 331], [0, 405.0, 236], [0, 0, 1]])
D = np.array([-0.28, 0.07, 0.0012, -0.0021, 0.0])


def calibration(extension: str) -> bytes:
    """What cv2.FileStorage writes."""
    storage = cv2.FileStorage(f".{extension}", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", D)
    text: str = storage.releaseAndGetString()
    return text.encode()


ROS = f"""image_width: 640
image_height: 480
camera_name: left
camera_matrix:
  rows: 3
  cols: 3
  data: {K.reshape(-1).tolist()}
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: {D.tolist()}
""".encode()
PLAIN = orjson.dumps({"K": K.tolist(), "D": D.tolist(), "image_size": [640, 480]})


@pytest.mark.parametrize(
    "body", [calibration("yml"), calibration("json"), ROS, PLAIN], ids=["yml", "json", "ros", "K D"]
)
def test_a_calibration_is_read_as_opencv_means_it(body: bytes) -> None:
    """YAML and JSON of cv2.FileStorage, ROS camera files and plain JSON give the maps of cv2.undistort."""
    maps = pixel_maps(FILES.read_map(ImportFormat.OPENCV, body), 640, 480)
    expected = cv2.initUndistortRectifyMap(K, D, None, K, (640, 480), cv2.CV_32FC1)
    for ours_, theirs in zip(maps, expected, strict=True):
        np.testing.assert_allclose(ours_, theirs, atol=2e-3)


LENS = {
    "camera_maker": "NIKON CORPORATION",
    "camera": "NIKON D3S",
    "lens": "Nikkor 28mm f/2.8D AF",
    "focal_length_mm": 28,
    "width": 640,
    "height": 426,
}


def test_a_lensfun_profile_is_read() -> None:
    """The map of the Nikkor 28mm bends, more at the edge than in the middle, and less than a twentieth of the width."""
    pytest.importorskip("lensfunpy", reason="the extra [lensfun] is not installed")
    grid = Grid.from_map(FILES.read_map(ImportFormat.LENSFUN, orjson.dumps(LENS)), 33, 33)
    offset = np.abs(grid.source - Grid.identity(33, 33).source)
    assert offset[16, 16].max() < 1e-3
    assert 1e-3 < offset[0, 0].max() < 0.05
    assert grid.is_unfolded


@pytest.mark.parametrize(
    "change",
    [{"lens": "No Such Lens 3000"}, {"camera": "No Such Camera"}, {"width": "wide"}, {"focal_length_mm": None}],
)
def test_an_unknown_lens_is_a_sentence(change: dict[str, object]) -> None:
    pytest.importorskip("lensfunpy", reason="the extra [lensfun] is not installed")
    with pytest.raises(InvalidGrid):
        FILES.read_map(ImportFormat.LENSFUN, orjson.dumps(LENS | change))


EXR_MAGIC, TIFF_MAGIC = b"\x76\x2f\x31\x01", b"II*\0"


@pytest.mark.parametrize("kind", [kind for kind in ImportFormat if kind is not ImportFormat.JSON], ids=str)
@pytest.mark.parametrize(
    "body", [b"", b"nonsense", b"{}", b"[1]", EXR_MAGIC + b"x" * 99, TIFF_MAGIC + b"x" * 99, b"PK\3\4" + b"x" * 99]
)
def test_a_broken_file_is_a_sentence(kind: ImportFormat, body: bytes) -> None:
    """Nothing but a typed error comes of files that are empty, cut off or of another kind."""
    if kind is ImportFormat.STMAP_EXR:
        pytest.importorskip("OpenEXR", reason="the extra [export] is not installed")
    if kind is ImportFormat.LENSFUN:
        pytest.importorskip("lensfunpy", reason="the extra [lensfun] is not installed")
    with pytest.raises(InvalidGrid):
        FILES.read_map(kind, body)


def test_objects_are_not_unpickled() -> None:
    """A numpy archive from elsewhere may hold code; it is not run."""
    out = io.BytesIO()
    np.savez(out, map_x=np.array([{}]), map_y=np.array([{}]))
    with pytest.raises(InvalidGrid):
        FILES.read_map(ImportFormat.NPZ, out.getvalue())


@pytest.mark.parametrize(("kind", "width"), [(ExportFormat.NPZ_FIXED, 40000), (ExportFormat.FFMPEG, 20000)])
def test_what_a_format_cannot_hold_is_refused(kind: ExportFormat, width: int) -> None:
    wide = np.zeros((1, width), np.float32)
    with pytest.raises(InvalidOption):
        FILES.write_map(kind, DenseMap(wide, wide))
