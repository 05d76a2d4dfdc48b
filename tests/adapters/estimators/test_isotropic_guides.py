from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from unbend_service.adapters.estimators.isotropic_guides import GuideFrame, mirrored
from unbend_service.domain.maps import Float64, target_lattice

FRAME = GuideFrame(nodes=-0.9 * np.cos(np.pi * np.arange(6) / 5), anchors=np.linspace(-0.9, 0.9, 6))


@given(arrays(np.float64, (2, 6, 6), elements=st.floats(-0.03, 0.03)), st.sampled_from([(1.0, 0.6), (0.5, 1.0)]),
       st.floats(-0.8, 0.8), st.floats(-0.8, 0.8))  # fmt: skip
def test_the_change_of_frame_is_exact(offsets: Float64, half: tuple[float, float], s: float, t: float) -> None:
    """The map of a wide or tall picture is the isotropic map, restricted to it."""
    values = FRAME.straight + offsets
    isotropic = FRAME.guides(values)
    centred = FRAME.guides(values, *half)
    target = np.array([s, t])
    np.testing.assert_allclose(centred(target) * half, isotropic(target * half), atol=1e-6)


@given(arrays(np.float64, (2, 6, 6), elements=st.floats(-0.03, 0.03)), st.floats(-0.8, 0.8), st.floats(-0.8, 0.8))
def test_mirrored_values_are_the_mirrored_map(offsets: Float64, s: float, t: float) -> None:
    """Mirroring the answer mirrors the correction."""
    values = FRAME.straight + offsets
    straight = FRAME.guides(values)(np.array([s, t]))
    reflected = FRAME.guides(mirrored(values))(np.array([-s, t]))
    np.testing.assert_allclose(reflected, straight * [-1, 1], atol=1e-6)


def smooth_offsets(bend: float, shear: float) -> Float64:
    """Values of a gentle, smooth map."""
    values = FRAME.straight
    x, a = FRAME.nodes[None, :], FRAME.anchors[:, None]
    values[0] += bend * a * (x * x - 0.3) + shear * x
    values[1] += bend * a * (x * x - 0.3)
    return values


@given(st.floats(-0.15, 0.15), st.floats(-0.1, 0.1))
def test_straightening_is_the_way_back(bend: float, shear: float) -> None:
    """Where a target point comes from, there it is straightened to."""
    values = smooth_offsets(bend, shear)
    target = target_lattice(7, 7, 0.8).reshape(-1, 2)
    x, y = FRAME.guides(values)(target).T
    s, t = FRAME.straightened(values, x, y)
    np.testing.assert_allclose(np.stack([s, t], 1), target, atol=1e-4)


@given(st.floats(-0.12, 0.12), st.floats(-0.12, 0.12), st.floats(-0.05, 0.05))
def test_a_composition_does_one_after_the_other(one: float, other: float, shear: float) -> None:
    """The fitted guides of two maps in turn are within a tenth of a pixel at 256 of doing them in turn."""
    first, second = smooth_offsets(one, shear), smooth_offsets(other, 0.0)
    extent = (1.0, 0.7)
    target = target_lattice(9, 9)
    both = FRAME.guides(FRAME.composed(first, second, *extent), *extent)(target)
    in_turn = FRAME.guides(first, *extent)(FRAME.guides(second, *extent)(target))
    assert np.linalg.norm((both - in_turn) * extent, axis=-1).mean() * 128 < 0.1


def test_bend_sees_curves_and_no_pose() -> None:
    """Shifts, rotations and keystones are no bend; a bow is, in half long sides."""
    x, a = FRAME.nodes[None, :], FRAME.anchors[:, None]
    pose = np.stack([0.01 * x + 0.02 * a * x + 0.01, -0.01 * x + 0.02 * a * a + 0 * x])
    bow = np.stack([0.03 * x * x + 0 * a, 0 * x * a])
    assert FRAME.bend(pose, 1.0, 1.0) < 1e-9
    assert FRAME.bend(bow, 1.0, 1.0) > 0.005
