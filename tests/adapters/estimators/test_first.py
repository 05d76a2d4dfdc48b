from __future__ import annotations

import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from unbend_service.adapters.estimators.cards import read_card, shipped_models
from unbend_service.adapters.estimators.catalogue import load_estimator
from unbend_service.adapters.estimators.first import guides_from_nodes, mirrored_nodes
from unbend_service.application.ports import Bytes, Estimator
from unbend_service.domain.errors import ModelUnavailable
from unbend_service.domain.maps import Float64, target_lattice

NODES = np.array([0.05, 0.35, 0.65, 0.95])


@pytest.fixture(scope="module")
def estimator() -> Estimator:
    return load_estimator("first", threads=1)


def facade(side: int = 512) -> Bytes:
    """A drawn house front: brick courses, five columns of windows on four floors, a cornice."""
    picture = np.full((side, side), 170, np.uint8)
    for y in range(0, side, 16):
        cv2.line(picture, (0, y), (side, y), 150, 1)
    for row in range(5):
        for column in range(6):
            x, y = 20 + column * 84, 30 + row * 100
            cv2.rectangle(picture, (x, y), (x + 46, y + 64), 60, -1)
            cv2.rectangle(picture, (x, y), (x + 46, y + 64), 225, 3)
            cv2.line(picture, (x + 23, y), (x + 23, y + 64), 225, 2)
    for y in (8, 118, 218, 318, 418):
        cv2.rectangle(picture, (0, y), (side, y + 6), 110, -1)
    return picture


def bent(picture: Bytes, strength: float) -> tuple[Bytes, Float64]:
    """A barrel-distorted centre crop of half the size, and the true source of a 17x17 target lattice (centred)."""
    half = picture.shape[0] // 4

    def straight(source: Float64) -> Float64:  # one-parameter division model: source -> target
        return np.asarray(source / (1 - strength * (source**2).sum(axis=-1, keepdims=True)))

    side = 2 * half
    centres = (2 * np.arange(side) + 1) / side - 1
    target = straight(np.stack(np.meshgrid(centres, centres), axis=-1))
    pixels = ((target + 2) * half - 0.5).astype(np.float32)
    crop = cv2.remap(picture, pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    lattice = target_lattice(17, 17)
    source = lattice.copy()
    for _ in range(50):
        source = lattice * (1 - strength * (source**2).sum(axis=-1, keepdims=True))
    return np.asarray(crop, np.uint8), source


def error(estimator: Estimator, picture: Bytes, source: Float64) -> tuple[float, float]:
    """Mean error of the estimate and of doing nothing, px at 256, where the source is visible."""
    visible = np.abs(source).max(axis=-1) <= 1
    lattice = target_lattice(17, 17)
    guessed = estimator.estimate(picture).guides(lattice)
    return (
        float(np.linalg.norm(guessed - source, axis=-1)[visible].mean() * 128),
        float(np.linalg.norm(lattice - source, axis=-1)[visible].mean() * 128),
    )


@given(arrays(np.float64, (2, 4, 4), elements=st.floats(-0.5, 0.5)))
def test_polynomials_survive_the_change_of_frame(coefficients: Float64) -> None:
    """Node values of a known polynomial give back its very coefficients."""
    x = 2 * NODES - 1
    values = (np.einsum("fkp,np->fkn", coefficients, np.vander(x, 4, increasing=True)) + 1) / 2
    guides = guides_from_nodes(values, NODES, NODES)
    np.testing.assert_allclose(guides.rows.coefficients, coefficients[0], atol=1e-12)
    np.testing.assert_allclose(guides.columns.coefficients, coefficients[1], atol=1e-12)
    np.testing.assert_allclose(guides.rows.anchors, x, atol=1e-15)


def test_node_values_at_their_anchors_change_nothing() -> None:
    """What the network says of an undistorted picture is the identity."""
    values = np.broadcast_to(NODES[:, None], (2, 4, 4))
    lattice = target_lattice(9, 9)
    np.testing.assert_allclose(guides_from_nodes(values, NODES, NODES)(lattice), lattice, atol=1e-9)


@given(arrays(np.float64, (2, 4, 4), elements=st.floats(-0.03, 0.03)), st.floats(-0.8, 0.8), st.floats(-0.8, 0.8))
def test_mirrored_nodes_are_the_mirrored_map(offsets: Float64, s: float, t: float) -> None:
    """Mirroring the answer mirrors the correction, and twice is once too many."""
    values = NODES[None, :, None] + offsets
    straight = guides_from_nodes(values, NODES, NODES)(np.array([s, t]))
    mirrored = guides_from_nodes(mirrored_nodes(values), NODES, NODES)(np.array([-s, t]))
    np.testing.assert_allclose(mirrored, straight * [-1, 1], atol=1e-7)
    np.testing.assert_allclose(mirrored_nodes(mirrored_nodes(values)), values, atol=1e-15)


def test_a_mirrored_picture_gives_mirrored_guides(estimator: Estimator) -> None:
    """Left and right are treated alike."""
    picture, _ = bent(facade(), 0.15)
    picture = picture[:, 20:].copy()
    lattice = target_lattice(17, 17)
    direct = estimator.estimate(picture)
    mirrored = estimator.estimate(np.ascontiguousarray(picture[:, ::-1]))
    np.testing.assert_allclose(mirrored.guides(lattice * [-1, 1]) * [-1, 1], direct.guides(lattice), atol=1e-4)
    assert mirrored.confidence == pytest.approx(direct.confidence, abs=1e-3)


@pytest.mark.parametrize("strength", [0.1, 0.18])
def test_a_bent_facade_is_mostly_straightened(estimator: Estimator, strength: float) -> None:
    """Of a clear barrel distortion at least two thirds are seen."""
    ours, nothing = error(estimator, *bent(facade(), strength))
    assert ours < nothing / 3


def test_a_straight_facade_is_hardly_moved(estimator: Estimator) -> None:
    """An undistorted drawing moves by less than 1.5 px at 256 on average, and the estimate is confident."""
    picture, source = bent(facade(), 0.0)
    ours, nothing = error(estimator, picture, source)
    assert nothing < 1e-6
    assert ours < 1.5
    assert estimator.estimate(picture).confidence > 0.7


@pytest.mark.parametrize("shape", [(1, 1), (1, 4000), (3000, 2), (480, 640)])
@pytest.mark.parametrize("grey", [0, 128, 255])
def test_a_blank_picture_of_any_size_gets_an_answer(estimator: Estimator, shape: tuple[int, int], grey: int) -> None:
    """Pictures without any content are estimated like others, and the confidence stays a number of 0..1."""
    estimate = estimator.estimate(np.full(shape, grey, np.uint8))
    assert np.isfinite(estimate.guides(target_lattice(9, 9))).all()
    assert 0 <= estimate.confidence <= 1
    assert estimate.confidence_kind == "mirror_agreement"


def test_an_answer_does_not_depend_on_what_else_runs(estimator: Estimator) -> None:
    """Four threads that share the estimator get the answers that they would get alone."""
    pictures = [bent(facade(), strength)[0] for strength in (0.0, 0.05, 0.1, 0.2)]
    alone = [estimator.estimate(picture).guides.rows.coefficients for picture in pictures]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(estimator.estimate, pictures * 4))
    for estimate, expected in zip(together, alone * 4, strict=True):
        np.testing.assert_array_equal(estimate.guides.rows.coefficients, expected)


def test_a_session_starts_no_more_threads_than_granted() -> None:
    """``estimator_threads`` bounds what an estimate uses: the caller's thread and the rest of the count."""
    program = (
        "import os\n"
        "from unbend_service.adapters.estimators.catalogue import load_estimator\n"
        "count = lambda: len(os.listdir('/proc/self/task'))\n"
        "load_estimator('first', 1)\n"  # whatever the runtime starts once for all
        "counts = [count()]\n"
        "kept = []\n"
        "for threads in (1, 3):\n"
        "    kept.append(load_estimator('first', threads))\n"
        "    counts.append(count())\n"
        "print(*counts)\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    result = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True, timeout=60
    )
    base, one, three = (int(word) for word in result.stdout.split())
    assert one - base == 0
    assert three - one == 2


def test_the_model_is_named_by_its_content(estimator: Estimator) -> None:
    """Name and hash of the weights travel with every estimate."""
    card = read_card("first")
    assert (estimator.model.name, estimator.model.sha256) == ("first", card.sha256)
    assert estimator.estimate(facade(64)).model == estimator.model


@pytest.mark.parametrize("name", list(shipped_models()))
def test_every_shipped_model_is_whole(name: str) -> None:
    """Each model that is offered has its weights, a true card, and a page on how it was made."""
    card = read_card(name)
    assert card.name == name
    assert card.weights.with_suffix(".md").read_text().startswith(f"# {name}\n")


def test_a_model_may_lie_anywhere(tmp_path: Path) -> None:
    """The setting takes the path of an .onnx file with its card beside it."""
    shipped = shipped_models()["first"]
    weights = tmp_path / "mine.onnx"
    weights.write_bytes(shipped.read_bytes())
    weights.with_suffix(".json").write_text(shipped.with_suffix(".json").read_text())
    assert load_estimator(str(weights), 1).estimate(facade(64)).guides.rows.degree == 3


def _write_model(folder: Path, weights: bytes, card: object) -> str:
    (folder / "model.onnx").write_bytes(weights)
    (folder / "model.json").write_text(json.dumps(card) if not isinstance(card, str) else card)
    return str(folder / "model.onnx")


EMPTY_SHA256 = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
GOOD = {"nodes": [0.05, 0.95], "anchors": [0.05, 0.95]}


@pytest.mark.parametrize(
    ("card", "said"),
    [
        ("{", "cannot be read"),
        ([], "cannot be read"),
        ({"name": "m", "kind": "picture"}, "cannot be read"),
        ({"name": "m", "kind": "picture", "sha256": "0" * 64}, "not those of their card"),
        ({"name": "m", "kind": "crystal ball", "sha256": EMPTY_SHA256}, "unknown kind"),
        ({"name": "m", "kind": "picture", "sha256": EMPTY_SHA256}, "needs nodes and anchors"),
        (
            {"name": "m", "kind": "picture", "sha256": EMPTY_SHA256, "parameters": GOOD | {"nodes": [0.1, 0.8]}},
            "not symmetric",
        ),
        ({"name": "m", "kind": "picture", "sha256": EMPTY_SHA256, "parameters": GOOD}, "cannot be loaded"),
    ],
)
def test_a_broken_model_is_refused_by_name(tmp_path: Path, card: object, said: str) -> None:
    """Whatever is wrong with a model file, the error says so and names the setting."""
    with pytest.raises(ModelUnavailable, match=said) as caught:
        load_estimator(_write_model(tmp_path, b"", card), 1)
    assert caught.value.setting == "model"


def test_weights_of_another_shape_are_refused(tmp_path: Path) -> None:
    """A card that promises other outputs than the weights have is not believed."""
    weights = shipped_models()["first"]
    card = {**json.loads(weights.with_suffix(".json").read_text()), "parameters": GOOD}
    with pytest.raises(ModelUnavailable, match="not what the card says"):
        load_estimator(_write_model(tmp_path, weights.read_bytes(), card), 1)


def test_an_unknown_model_lists_those_that_ship(tmp_path: Path) -> None:
    """A misspelt name is answered with the names that exist; weights without a card with the name of the card."""
    with pytest.raises(ModelUnavailable, match="no model 'frist'") as caught:
        load_estimator("frist")
    assert caught.value.setting == "model"
    assert "first" in (caught.value.allowed or "")
    (tmp_path / "bare.onnx").write_bytes(b"")
    with pytest.raises(ModelUnavailable, match=r"no card 'bare\.json'"):
        load_estimator(str(tmp_path / "bare.onnx"))
