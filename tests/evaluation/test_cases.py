"""The pictures that models are measured on are what they are said to be."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from unbend_service.domain.cameras import Camera
from unbend_service.domain.errors import InvalidOption
from unbend_service.domain.maps import target_lattice
from unbend_service.evaluation.cases import Case, Photograph, read_photographs
from unbend_service.evaluation.chessboards import calibrated, chessboard_cases, has_chessboards
from unbend_service.evaluation.families import BENT, FAMILIES, family_cases
from unbend_service.evaluation.lenses import cameras, is_straight, photographed, undistorted
from unbend_service.evaluation.measures import map_errors
from unbend_service.evaluation.oblique import oblique_cases


def photograph(seed: int = 0) -> Photograph:
    noise = np.random.default_rng(seed).integers(0, 256, (30, 40, 3), dtype=np.uint8)
    return Photograph(cv2.resize(noise, (640, 480), interpolation=cv2.INTER_CUBIC), "drawn", Path("drawn.png"))


def corrected_differs_by(case: Case, original: np.ndarray) -> float:
    """Mean grey levels between the original and the picture after its true correction, away from the border."""
    height, width = case.picture.shape
    target = target_lattice(48, 48, 0.98)
    source = case.truth(target)
    inside = (np.abs(source) < 0.97).all(-1)

    def sampled(picture: np.ndarray, points: np.ndarray) -> np.ndarray:
        at = (np.nan_to_num(points) + 1) / 2 * np.array([width, height]) - 0.5
        return cv2.remap(picture, at[..., 0].astype("f4"), at[..., 1].astype("f4"), cv2.INTER_LINEAR).astype(int)

    return float(np.abs(sampled(case.picture, source) - sampled(original, target))[inside].mean())


@pytest.mark.parametrize("family", FAMILIES)
def test_the_truth_of_a_family_undoes_it(family: str) -> None:
    """The true correction of a distorted picture is the original, but for the sampling."""
    case = next(family_cases(family, [photograph()]))
    assert case.original is not None
    assert corrected_differs_by(case, case.original) < 3


@pytest.mark.parametrize("family", BENT)
def test_a_bent_family_is_not_straight(family: str) -> None:
    """The measure of the true correction would notice that nothing was done."""
    case = next(family_cases(family, [photograph()]))
    assert case.original is not None
    undone = corrected_differs_by(case, case.original)
    assert corrected_differs_by(Case("", case.picture, lambda target: target), case.original) > 3 * undone


def test_real_lenses_are_always_the_same() -> None:
    """Figures of two days can be compared; every model is there, two of the cameras are straight."""
    one, other = cameras(), cameras()
    assert list(one) == list(other)
    assert all(one[name].coefficients == other[name].coefficients for name in one)
    assert sum(map(is_straight, one)) == 2
    assert all(not any(camera.coefficients) for name, camera in one.items() if is_straight(name))


def test_a_real_lens_bends_what_its_camera_model_says() -> None:
    """OpenCV's own undistortion brings the photograph back; the picture is all photograph, no border."""
    named = cameras()
    for name in ("rational-1", "thin-prism-1", "fisheye-1"):
        camera = named[name]
        source = np.random.default_rng(0).uniform(-0.98, 0.98, (200, 2))
        pixels = ((source + 1) / 2 * [camera.width, camera.height] - 0.5).reshape(-1, 1, 2)
        if camera.fisheye:
            expected = cv2.fisheye.undistortPoints(
                pixels, camera.matrix, np.array(camera.coefficients), P=camera.matrix
            )
        else:
            criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-10)
            expected = cv2.undistortPoints(
                pixels, camera.matrix, np.array(camera.coefficients), P=camera.matrix, criteria=criteria
            )
        found = (undistorted(camera, source) + 1) / 2 * [camera.width, camera.height] - 0.5
        np.testing.assert_allclose(found, expected.reshape(-1, 2), atol=0.02)


def test_a_camera_that_folds_is_refused() -> None:
    """No case is made of a model that means nothing at the corners of its picture."""
    folding = Camera(np.array([[100.0, 0, 128], [0, 100, 96], [0, 0, 1]]), (-0.6, 0.0, 0.0, 0.0), False, 256, 192)
    with pytest.raises(ArithmeticError):
        undistorted(folding, np.array([[0.99, 0.99]]))


def test_a_straight_camera_does_nothing() -> None:
    """So whatever a model does to its pictures is harm."""
    named = cameras()
    for name in ("straight-1", "thin-prism-1"):
        case = photographed(name, named[name], photograph())
        errors = map_errors(lambda points: points, *case.correspondences(), case.half_px)
        assert (errors[1] < 1e-6) == is_straight(case.group)


def test_oblique_views_have_upright_twins_under_the_same_lens() -> None:
    """What differs between the two is the pose of the scene alone."""
    pairs = list(oblique_cases([photograph(), photograph(1)]))
    assert len(pairs) == 4 * (len(BENT) + 1)
    points = np.random.default_rng(1).uniform(-0.8, 0.8, (50, 2))
    for upright, oblique in zip(pairs[::2], pairs[1::2], strict=True):
        assert (upright.group.split()[1], oblique.group.split()[0]) == (oblique.group.split()[1], "oblique")
        np.testing.assert_array_equal(upright.truth(points), oblique.truth(points))
        assert (upright.picture != oblique.picture).mean() > 0.5


def drawn_board(camera: Camera, turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """A chessboard of 10 x 7 squares as a camera without distortion sees it."""
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(camera.matrix).T
    pose = np.stack([turn[:, 0], turn[:, 1], shift], 1)
    plane = rays @ np.linalg.inv(pose).T
    u, v = plane[..., 0] / plane[..., 2], plane[..., 1] / plane[..., 2]
    board = (np.floor(u) + np.floor(v)) % 2 == 0
    inside = (u > 0) & (u < 10) & (v > 0) & (v < 7)
    return cv2.GaussianBlur(np.where(inside & board, 20, 230).astype(np.uint8), (0, 0), 0.7)


def test_chessboards_calibrate_their_camera(tmp_path: Path) -> None:
    """The truth of photographed chessboards is the camera that took them."""
    camera = Camera(np.array([[500.0, 0, 319.5], [0, 500, 239.5], [0, 0, 1]]), (0.0,) * 5, False, 640, 480)
    views = []
    for across, down in ((0.4, 0.3), (-0.4, 0.3), (0.3, -0.4), (-0.3, -0.4), (0.5, 0.0), (0.0, 0.5), (0.0, 0.0)):
        turn, _ = cv2.Rodrigues(np.array([across, down, 0.05]))
        views.append(drawn_board(camera, turn, np.array([down, across, 10.0]) - turn @ [5.0, 3.5, 0.0]))
    found = calibrated(views)
    assert found.matrix[0, 0] == pytest.approx(500, rel=0.02)
    errors = map_errors(found, *Case("", views[0], camera).correspondences(), np.array([128.0, 96.0]))
    assert errors[1] < 0.2
    for number, view in enumerate(views):
        for name in ("left", "right"):
            cv2.imwrite(str(tmp_path / f"{name}{number + 1:02d}.png"), view)
    assert has_chessboards(tmp_path)
    assert [case.group for case in chessboard_cases(tmp_path)] == ["chessboard-left"] * 7 + ["chessboard-right"] * 7


def test_too_few_chessboards_are_refused() -> None:
    """A calibration over nothing would be called the truth otherwise."""
    with pytest.raises(InvalidOption, match="0 chessboards"):
        calibrated([np.full((120, 160), 90, np.uint8)] * 6)


def test_photographs_are_those_of_the_validation_split(tmp_path: Path) -> None:
    """Nothing that a model was trained on is measured; a folder without an index is taken as it is."""
    for name in "abc":
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.full((8, 8, 3), ord(name), np.uint8))
    assert len(read_photographs(tmp_path, 10)) == 3
    (tmp_path / "index.csv").write_text("path,split,source\na.png,val,x\nb.png,train,x\nc.png,val,y\n")
    assert {p.path.name for p in read_photographs(tmp_path, 10)} == {"a.png", "c.png"}
    assert [p.path.name for p in read_photographs(tmp_path, 10, ("y",))] == ["c.png"]
    with pytest.raises(InvalidOption, match="no photographs"):
        read_photographs(tmp_path, 10, ("z",))
