from __future__ import annotations

import json
import shutil
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from unbend_service.adapters.estimators import chains, lineset, picture_branch, views
from unbend_service.adapters.estimators.cards import shipped_models
from unbend_service.adapters.estimators.catalogue import load_estimator
from unbend_service.application.ports import Bytes, Estimator
from unbend_service.domain.decision import TRUSTING, decide
from unbend_service.domain.errors import ModelUnavailable
from unbend_service.domain.homography import apply_homography, fit_homography, without_plane_part
from unbend_service.domain.maps import Float64, target_lattice
from unbend_service.domain.records import Correct, Outcome


@pytest.fixture(scope="module")
def estimator() -> Estimator:
    return load_estimator("lineset", threads=1)


def facade(width: int, height: int) -> Bytes:
    """A drawn house front: brick courses, windows in rows and columns, a cornice over each floor."""
    picture = np.full((height, width), 170, np.uint8)
    for y in range(0, height, 16):
        cv2.line(picture, (0, y), (width, y), 150, 1)
    for y in range(30, height, 100):
        for x in range(20, width, 84):
            cv2.rectangle(picture, (x, y), (x + 46, y + 64), 60, -1)
            cv2.rectangle(picture, (x, y), (x + 46, y + 64), 225, 3)
            cv2.line(picture, (x + 23, y), (x + 23, y + 64), 225, 2)
        cv2.rectangle(picture, (0, y - 12), (width, y - 6), 110, -1)
    return picture


def bent(width: int, height: int, strength: float) -> tuple[Bytes, Float64]:
    """A radially distorted view of the middle of a facade, and the true source (centred) of a 17x17 target lattice.

    strength: l of target = source / (1 + l |source|^2), isotropic frame (half the long side is 1); l < 0 is a barrel.
    """
    half = max(width, height) / 2
    extent = np.array([width, height]) / (2 * half)
    x, y = (2 * np.arange(n) + 1 - n for n in (width, height))
    seen = np.stack(np.meshgrid(x, y), axis=-1) / (2 * half)
    pixels = seen / (1 + strength * (seen**2).sum(axis=-1, keepdims=True)) * half + np.array([width, height]) - 0.5
    pixels = pixels.astype(np.float32)
    picture = cv2.remap(facade(2 * width, 2 * height), pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR)
    target = target_lattice(17, 17) * extent
    under = 1 - 4 * strength * (target**2).sum(axis=-1, keepdims=True)
    source = np.where(under > 0, 2 * target / (1 + np.sqrt(np.maximum(under, 0))), 9)  # a pincushion ends somewhere
    return np.asarray(picture, np.uint8), source / extent


def bend_error(estimator: Estimator, picture: Bytes, source: Float64) -> tuple[float, float]:
    """Mean error of the nonlinear part of the estimate and of doing nothing, px at 256, where the source is visible;
    the true map's own plane part is taken off, so that only straightness counts."""
    lattice = target_lattice(17, 17)
    visible = np.abs(source).max(axis=-1) <= 0.95
    guides = estimator.estimate(picture).guides

    def misfit(points: Float64) -> float:
        plane = fit_homography(points[visible], source[visible])
        return float(np.linalg.norm(apply_homography(plane, points) - source, axis=-1)[visible].mean() * 128)

    return misfit(guides(lattice)), misfit(lattice)


@pytest.mark.parametrize("size", [(256, 256), (640, 360), (300, 420)])
@pytest.mark.parametrize("strength", [-0.18, 0.2])
def test_a_bent_facade_of_any_aspect_is_mostly_straightened(
    estimator: Estimator, size: tuple[int, int], strength: float
) -> None:
    """Of a clear barrel or pincushion at least two thirds are seen, whatever the shape of the picture."""
    ours, nothing = bend_error(estimator, *bent(*size, strength))
    assert nothing > 1
    assert ours < nothing / 3


def test_a_clear_case_is_corrected_with_confidence(estimator: Estimator) -> None:
    """The estimate says that it is sure, and how large an error to expect."""
    estimate = estimator.estimate(bent(512, 384, -0.18)[0])
    assert estimate.confidence > 0.8
    assert estimate.confidence_kind == "calibrated_probability"
    assert estimate.expected_error is not None
    assert estimate.expected_error * 128 < 2


def test_a_straight_facade_is_left_as_it_is(estimator: Estimator) -> None:
    """The nonlinear part of an undistorted drawing's estimate stays below half a pixel at 256."""
    lattice = target_lattice(17, 17)
    moved = without_plane_part(estimator.estimate(facade(512, 400)).guides)(lattice) - lattice
    assert np.linalg.norm(moved, axis=-1).mean() * 128 < 0.5


def test_the_weights_of_clear_provenance_straighten_too() -> None:
    """`lineset-free` is the same estimator under its own name and threshold."""
    free = load_estimator("lineset-free", threads=1)
    picture, source = bent(480, 360, -0.18)
    error, nothing = bend_error(free, picture, source)
    assert error < 0.25 * nothing
    estimate = free.estimate(picture)
    assert estimate.model.name == "lineset-free"
    assert estimate.confidence >= free.model.caution.full_confidence


@pytest.mark.parametrize("shape", [(256, 256), (1, 1), (3, 2000)])
def test_a_picture_without_edges_is_left_alone(estimator: Estimator, shape: tuple[int, int]) -> None:
    """No edges, no evidence: straight guides, confidence 0, and the decision says so."""
    estimate = estimator.estimate(np.full(shape, 128, np.uint8))
    assert estimate.confidence == 0
    record = decide(
        estimate.guides, estimate.confidence, estimate.confidence_kind, estimate.model.name,
        correct=Correct.NONLINEAR, caution=estimator.model.caution,
    )  # fmt: skip
    assert record.outcome is Outcome.LEFT_ALONE


def test_noise_is_not_taken_for_a_lens(estimator: Estimator) -> None:
    """Edges that are not of lines give no confident correction."""
    noise = np.random.default_rng(0).integers(0, 256, (300, 400), dtype=np.uint8)
    assert estimator.estimate(cv2.GaussianBlur(noise, (0, 0), 2.5)).confidence < 0.5


def test_a_mirrored_picture_gives_mirrored_guides(estimator: Estimator) -> None:
    """Left and right are treated alike, up to how a picture's pixels are traced."""
    picture, _ = bent(400, 300, -0.15)
    picture = np.ascontiguousarray(picture[:, 30:])
    lattice = target_lattice(9, 9)
    direct = estimator.estimate(picture).guides(lattice)
    mirrored = estimator.estimate(np.ascontiguousarray(picture[:, ::-1])).guides(lattice * [-1, 1]) * [-1, 1]
    assert np.linalg.norm(mirrored - direct, axis=-1).mean() * 128 < 0.4


def test_pictures_may_be_looked_at_from_several_threads(estimator: Estimator) -> None:
    """The same pictures give the same answers, whoever asks at the same time."""
    pictures = [bent(256, 200, s)[0] for s in (-0.1, 0.0, 0.1, 0.2)] * 3
    alone = [estimator.estimate(p).confidence for p in pictures]
    with ThreadPoolExecutor(4) as threads:
        together = [e.confidence for e in threads.map(estimator.estimate, pictures)]
    assert together == pytest.approx(alone, abs=1e-6)


@pytest.mark.parametrize(
    ("parameter", "value"), [("nodes", [0.1, 0.5]), ("anchors", [-0.5, 0.4]), ("confidence", [1.0]), ("looks", None)]
)
def test_a_card_that_does_not_fit_its_weights_is_refused(parameter: str, value: object, tmp_path: Path) -> None:
    """The message names the model and the setting."""
    weights = shipped_models()["lineset"]
    shutil.copy(weights, tmp_path / "odd.onnx")
    card = json.loads(weights.with_suffix(".json").read_text())
    card["parameters"][parameter] = value
    (tmp_path / "odd.json").write_text(json.dumps(card))
    with pytest.raises(ModelUnavailable) as refusal:
        load_estimator(str(tmp_path / "odd.onnx"), threads=1)
    assert refusal.value.setting == "model"


def test_a_picture_has_one_grid_wherever_it_lies_in_memory_and_however_many_threads_look(estimator: Estimator) -> None:
    """Nodes, cores, load and what else was computed before change no bit of an estimate, and so not the grid's id."""
    two_threads = load_estimator("lineset", threads=2)
    picture, _ = bent(192, 144, -0.2)
    place = np.random.default_rng(4)
    in_the_way: list[Float64] = []
    seen = set()
    for turn in range(12):
        in_the_way.append(np.zeros(int(place.integers(1, 9000))))
        memory = np.empty(picture.size + 64, np.uint8)
        moved = memory[turn : turn + picture.size].reshape(picture.shape)
        moved[:] = picture
        estimate = (estimator, two_threads)[turn % 2].estimate(moved)
        record = decide(estimate.guides, 1.0, "", "", correct=Correct.NONLINEAR, caution=TRUSTING)
        assert record.outcome is Outcome.CORRECTED
        seen.add((record.grid.id, estimate.confidence, estimate.guides.rows.coefficients.tobytes()))
    assert len(seen) == 1


@pytest.mark.parametrize(("threads", "others"), [(1, 0), (2, 1)])
def test_a_picture_is_looked_at_while_its_chains_are_traced(
    threads: int, others: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As long as the setting grants a second thread; where it grants one, no other works."""
    looked, workers = threading.Event(), set()

    def view_of(grey: Bytes) -> npt.NDArray[np.float32]:
        workers.add(threading.get_ident())
        looked.set()
        return views.view_of(grey)

    def extract(grey: Bytes) -> chains.EdgeChains:
        assert looked.wait(20 * others) or not others
        return chains.extract(grey)

    monkeypatch.setattr(picture_branch, "view_of", view_of)
    monkeypatch.setattr(lineset, "extract", extract)
    assert load_estimator("lineset", threads).estimate(bent(256, 200, -0.1)[0]).confidence > 0
    assert len(workers - {threading.get_ident()}) == others
