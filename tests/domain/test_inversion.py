from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.domain.lenses import BARREL, WAVE, affine, projective, radial, rotation, shear, wave
from unbend_service.domain.errors import FoldedGrid
from unbend_service.domain.fit import CROP, FULL, KEEP, Fit, with_fit
from unbend_service.domain.grid import Grid
from unbend_service.domain.inversion import InverseMap, inverse
from unbend_service.domain.maps import BackwardMap, Float64

#: Pixels of a picture of 1024 per centred unit.
PIXELS = 512
POINTS = np.random.default_rng(7).uniform(-1, 1, (4000, 2))

MAPS: dict[str, BackwardMap] = {
    "barrel": radial(BARREL),
    "decentred barrel": radial(BARREL, 0.2),
    "pincushion": radial(0.12),
    "wave": wave(WAVE),
    "half turn": rotation(170),
    "mirror": affine(np.diag([-1.0, 1.0]), np.zeros(2)),
    "projective": projective(0.2),
    "shear": shear(0.4),
}


def seen(source: Float64) -> np.ndarray:
    return (np.abs(source) <= 1).all(axis=-1)


@pytest.mark.parametrize("fit", [KEEP, CROP, FULL], ids=str)
@pytest.mark.parametrize("name", MAPS)
def test_undistorting_and_redistorting_is_the_identity(name: str, fit: Fit) -> None:
    """Whatever is visible comes back to within a hundredth of a pixel of 1024, in both orders."""
    grid = with_fit(Grid.from_map(MAPS[name]), fit)
    back = InverseMap(grid)
    source = grid(POINTS)
    visible = seen(source)
    assert np.abs(back(source[visible]) - POINTS[visible]).max() * PIXELS < 0.01
    assert np.abs(grid(back(POINTS)) - POINTS).max() * PIXELS < 0.01


@given(st.floats(-0.3, 0.12), st.floats(-0.3, 0.3), st.floats(-60, 60), st.floats(-0.1, 0.1))
def test_any_lens_that_does_not_fold_can_be_inverted(
    strength: float, centre: float, degrees: float, amplitude: float
) -> None:
    """Radial, decentred, tilted and wavy at once: less than a tenth of a pixel of 1024."""
    lens, turn, sway = radial(strength, centre), rotation(degrees), wave(amplitude)
    grid = Grid.from_map(lambda target: lens(turn(sway(target)) * 0.8))
    if grid.is_unfolded:
        source = grid(POINTS)
        visible = seen(source)
        assert np.abs(InverseMap(grid)(source[visible]) - POINTS[visible]).max(initial=0) * PIXELS < 0.1


@pytest.mark.parametrize("name", MAPS)
def test_the_inverse_grid_is_as_good_as_a_lattice_can_be(name: str) -> None:
    """As a lattice the inverse is within a tenth of a pixel of 256, twice as fine as the grid, and does not fold."""
    grid = Grid.from_map(MAPS[name])
    back = inverse(grid)
    source = grid(POINTS)
    visible = seen(source)
    assert (back.rows, back.columns) == (129, 129)
    assert np.hypot(*(back(source[visible]) - POINTS[visible]).T).max() * 128 < 0.1
    assert back.is_unfolded


def test_the_identity_is_its_own_inverse() -> None:
    np.testing.assert_allclose(inverse(Grid.identity()).source, Grid.identity(129, 129).source, atol=1e-6)


def test_the_inverse_leads_out_of_a_cropped_frame() -> None:
    """A source point that a crop does not show lies beyond the frame, on the side where it was cut away."""
    grid = with_fit(Grid.from_map(radial(0.12)), CROP)
    right, top = InverseMap(grid)(np.array([[0.99, 0.0], [0.0, -0.99]]))
    assert right[0] > 1
    assert top[1] < -1


def test_a_fold_has_no_inverse() -> None:
    source = Grid.identity(9, 9).source.copy()
    source[4, 4] = source[4, 7]
    with pytest.raises(FoldedGrid):
        InverseMap(Grid(source))
