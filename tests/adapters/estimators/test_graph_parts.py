from __future__ import annotations

import numpy as np
import onnxruntime as ort
import pytest

from unbend_service.adapters.estimators.cards import companion, read_card
from unbend_service.adapters.estimators.graph_parts import headed, parted
from unbend_service.adapters.estimators.views import mirrored_maps

AWAITED = ("chain_nodes", "chain_spreads", "chain_state")


@pytest.fixture(scope="module")
def branch() -> bytes:
    return companion(read_card("lineset"), "branch").read_bytes()


def session(network: bytes) -> ort.InferenceSession:
    return ort.InferenceSession(network, providers=["CPUExecutionProvider"])


def test_both_parts_together_are_the_network(branch: bytes) -> None:
    """Not a bit of what it says changes, and what can be done early does not ask for what comes late."""
    random = np.random.default_rng(3)
    whole = session(branch)
    told = {one.name: random.random((2, *one.shape[1:]), dtype=np.float32) for one in whole.get_inputs()}
    parts = parted(branch, AWAITED)
    assert parts is not None
    early, late = session(parts.early), session(parts.late)
    assert {one.name for one in early.get_inputs()}.isdisjoint(AWAITED)
    between = early.run(parts.between, {one.name: told[one.name] for one in early.get_inputs()})
    known = told | dict(zip(parts.between, between, strict=True))
    said = late.run(["nodes", "errors"], {one.name: known[one.name] for one in late.get_inputs()})
    for part, expected in zip(said, whole.run(["nodes", "errors"], told), strict=True):
        assert np.array_equal(part, expected)


def test_the_front_end_can_be_run_apart(branch: bytes) -> None:
    """With its maps in place of the view the rest says the same; and those of the mirror image follow from them."""
    random = np.random.default_rng(4)
    parts = parted(branch, AWAITED)
    assert parts is not None
    heads = headed(parts.early, "/branch/front/")
    assert heads is not None
    early, front, trunk = session(parts.early), session(heads.early), session(heads.late)
    picture = random.random((1, 1, 192, 192), dtype=np.float32)
    extent = np.array([[1.0, 0.75]], np.float32)
    (maps,) = front.run(heads.between, {"view": picture, "extent": extent})
    (reflected,) = front.run(heads.between, {"view": np.ascontiguousarray(picture[..., ::-1]), "extent": extent})
    np.testing.assert_allclose(mirrored_maps(np.asarray(maps)), reflected, atol=1e-5)
    expected = early.run(parts.between, {"view": picture, "extent": extent})
    said = trunk.run(parts.between, {heads.between[0]: maps, "extent": extent})
    for part, whole in zip(said, expected, strict=True):
        np.testing.assert_allclose(part, whole, atol=1e-5)


def test_each_weight_is_in_one_part(branch: bytes) -> None:
    """Two parts take no more memory than the whole."""
    parts = parted(branch, AWAITED)
    assert parts is not None
    assert len(parts.early) + len(parts.late) < 1.01 * len(branch)
    assert min(len(parts.early), len(parts.late)) > 0.1 * len(branch)


def test_what_cannot_be_parted_is_left_whole(branch: bytes) -> None:
    """A network of which nothing can be done early, one that waits for nothing, and what is no network."""
    assert parted(branch, ("view", "extent", *AWAITED)) is None
    assert parted(branch, ()) is None
    assert parted(b"\xff" * 40, AWAITED) is None
    assert headed(branch, "/elsewhere/") is None
    assert headed(b"\xff" * 40, "/branch/front/") is None
