from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tests.domain.lenses import BARREL, PINCUSHION, error_px, radial, rotation, shear, wave
from unbend_service.domain.errors import FoldedGrid, InvalidGrid
from unbend_service.domain.fitting import guides_from_map
from unbend_service.domain.grid import MAX_POINTS, MAX_SOURCE, Float32, Grid, folded_share
from unbend_service.domain.maps import BackwardMap, Float64, target_lattice


def lattices(size: float = 16.0) -> st.SearchStrategy[Float32]:
    shapes = st.tuples(st.integers(2, 9), st.integers(2, 9), st.just(2))
    return shapes.flatmap(lambda shape: arrays(np.float32, shape, elements=st.floats(-size, size, width=32)))


@given(lattices())
def test_json_round_trip_is_exact(source: Float32) -> None:
    """A grid comes back from JSON to the bit, and under the same id."""
    grid = Grid(source)
    again = Grid.from_dict(json.loads(json.dumps(grid.to_dict())))
    assert again.source.tobytes() == grid.source.tobytes()
    assert again.id == grid.id


@given(lattices(), st.data())
def test_ids_tell_contents_apart(source: Float32, data: st.DataObject) -> None:
    """Equal lattices have equal ids; one number changed by the smallest step makes another id."""
    assert Grid(source.copy()).id == Grid(source).id
    changed = source.copy()
    index = data.draw(st.integers(0, source.size - 1))
    changed.flat[index] = np.nextafter(source.flat[index], np.float32(-np.sign(source.flat[index]) or 1))
    assert Grid(changed).id != Grid(source).id


def test_ids_know_the_shape() -> None:
    """The same points in another shape are another grid, and -0 is no other number than 0."""
    source = np.zeros((2, 8, 2), np.float32)
    assert Grid(source).id != Grid(source.reshape(4, 4, 2)).id
    assert Grid(-source).id == Grid(source).id


def test_an_id_is_for_ever() -> None:
    """Stored ids stay valid: that of the identity is written down here."""
    assert Grid.identity().id == "g5cf8994edc0b71cfe3317de6ca0c6ada"


@given(lattices(1.0), st.integers(0, 8), st.integers(0, 8))
def test_nodes_are_met(source: Float32, row: int, column: int) -> None:
    """At a lattice point the map is that point's source."""
    grid = Grid(source)
    row, column = row % grid.rows, column % grid.columns
    target = target_lattice(grid.rows, grid.columns)[row, column]
    np.testing.assert_allclose(grid(target), source[row, column], atol=1e-6)


@given(st.integers(2, 40), st.integers(2, 40), arrays(np.float64, (5, 2), elements=st.floats(-2.5, 2.5)))
def test_the_identity_is_the_identity_everywhere(rows: int, columns: int, target: Float64) -> None:
    """Also outside its frame, to the rounding of float32 carried outwards, and on the smallest lattices."""
    np.testing.assert_allclose(Grid.identity(rows, columns)(target), target, atol=2e-5)


@pytest.mark.parametrize("true", [rotation(5), shear(0.04)])
def test_the_continuation_of_a_plane_map_is_that_map(true: BackwardMap) -> None:
    """Near the frame a slight rotation or shear goes on as it is."""
    target = target_lattice(21, 21, 1.1)
    np.testing.assert_allclose(Grid.from_map(true)(target), true(target), atol=1e-4)


@pytest.mark.parametrize("strength", [BARREL, BARREL / 2])
def test_the_continuation_follows_a_lens(strength: float) -> None:
    """A barrel lens read from the inside of the frame is continued to where its picture's sides are within 1 px."""
    true = radial(strength)
    sides = 1 / (1 + strength)
    target = np.stack([np.linspace(-0.5, 0.5, 9), np.full(9, sides)], axis=-1)
    error = Grid.from_map(true)(target) - true(target)
    assert np.hypot(*error.T).max() < 1 * 2 / 256


@pytest.mark.parametrize("strength", [0.25, 0.3, PINCUSHION])
def test_nothing_comes_back_into_sight(strength: float) -> None:
    """Outside the frame of a strong pincushion, all of whose picture is in the frame, there is nothing to be seen."""
    grid = Grid.from_map(guides_from_map(radial(strength), points=25, polish=0))
    plane = target_lattice(129, 129, 2.0).reshape(-1, 2)
    outside = np.abs(plane).max(axis=1) > 1
    assert (np.abs(grid(plane[outside])) > 1).any(axis=1).all()


@given(lattices(3.0), st.floats(-8, 8), st.floats(-8, 8))
def test_the_continuation_is_finite(source: Float32, s: float, t: float) -> None:
    """However wild the lattice and however far the target: a number."""
    assert np.isfinite(Grid(source)(np.array([s, t]))).all()


@pytest.mark.parametrize(
    "true",
    [rotation(30), radial(BARREL), wave(0.25), lambda target: target * [-1, 1], lambda target: target[..., ::-1]],
)
def test_unfolded_grids_are_accepted(true: BackwardMap) -> None:
    """Rotated, bent, and mirrored grids keep one orientation and pass."""
    Grid.from_map(true).check_unfolded()


@pytest.mark.parametrize(
    "true",
    [
        lambda target: np.stack([np.abs(target[..., 0]), target[..., 1]], axis=-1),
        lambda target: np.stack([target[..., 0] + 0.5 * np.sin(np.pi * target[..., 0]), target[..., 1]], axis=-1) * 0.9,
        lambda target: target * 0,
        lambda target: target + 5,
        lambda target: target**2 - 0.5,
    ],
)
def test_folded_grids_are_refused(true: BackwardMap) -> None:
    """A map that turns over in sight, collapses, or shows nothing is a FoldedGrid."""
    with pytest.raises(FoldedGrid):
        Grid.from_map(true).check_unfolded()


@pytest.mark.parametrize(("row", "column"), [(0, 0), (3, 4), (8, 8)])
def test_one_turned_cell_is_seen(row: int, column: int) -> None:
    """A single lattice point pushed across its neighbours folds the grid; pushed within its cells it does not."""
    source = Grid.identity(9, 9).source.copy()
    source[row, column] -= 0.1
    assert folded_share(source) == 0
    inwards = 1 if row < 4 else -1
    source[row, column] += 0.1 + 0.3 * inwards
    with pytest.raises(FoldedGrid):
        Grid(source).check_unfolded()


def test_folds_out_of_sight_do_not_matter() -> None:
    """Lattice points all of whose cells lie outside the picture may be anywhere."""
    source = Grid.from_map(lambda target: target * 2, 17, 17).source.copy()
    source[0, 0] = [-1.5, -1.6]
    Grid(source).check_unfolded()


@pytest.mark.parametrize(
    "shape", [(1, 2, 2), (2, 1, 2), (2, 2, 3), (2, 2), (0, 0, 2), (MAX_POINTS + 1, 2, 2), (2, 2, 2, 1)]
)
def test_lattices_of_the_wrong_shape_are_refused(shape: tuple[int, ...]) -> None:
    """Anything but 2..1025 x 2..1025 x 2 is an InvalidGrid."""
    with pytest.raises(InvalidGrid, match="shape"):
        Grid(np.zeros(shape, np.float32))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e39, MAX_SOURCE * 1.001, -1e300])
def test_numbers_that_are_none_are_refused(value: float) -> None:
    """NaN, infinities and far-out points never enter a grid, from an array or from JSON."""
    source = target_lattice(3, 3)
    source[1, 1, 0] = value
    with pytest.raises(InvalidGrid):
        Grid(source)  # type: ignore[arg-type]  # float64 is what a careless caller passes
    with pytest.raises(InvalidGrid):
        Grid.from_dict({"rows": 3, "columns": 3, "source": source.reshape(-1, 2).tolist()})


GOOD = Grid.identity(2, 2).to_dict()


@pytest.mark.parametrize(
    "value",
    [
        None,
        [],
        {},
        GOOD | {"rows": 3},
        GOOD | {"rows": 2.0},
        GOOD | {"rows": True},
        GOOD | {"columns": "2"},
        GOOD | {"rows": -2, "columns": -2},
        GOOD | {"rows": 1, "columns": 4},
        GOOD | {"source": None},
        GOOD | {"source": [[0, 0]] * 3 + [[0]]},
        GOOD | {"source": [[0, 0, 0]] * 4},
        GOOD | {"source": [["0", "0"]] * 4},
        GOOD | {"source": [[True, False]] * 4},
        GOOD | {"source": [[0, None]] * 4},
        GOOD | {"source": [[0, 10**400]] * 4},
        GOOD | {"source": [0] * 4},
        GOOD | {"source": [{"x": 0, "y": 0}] * 4},
    ],
)
def test_broken_json_is_refused(value: object) -> None:
    """Whatever JSON can hold, from_dict raises InvalidGrid or gives a grid."""
    with pytest.raises(InvalidGrid):
        Grid.from_dict(value)


def test_whole_numbers_are_numbers() -> None:
    """JSON writers that drop the point are understood."""
    grid = Grid.from_dict({"rows": 2, "columns": 2, "source": [[-1, -1], [1, -1], [-1, 1], [1, 1]]})
    assert grid.id == Grid.identity(2, 2).id


def test_grids_cannot_be_changed() -> None:
    """The lattice is a read-only copy, so that the id stays true."""
    source = target_lattice(3, 3).astype(np.float32)
    grid = Grid(source)
    source[0, 0] = 0
    assert grid.source[0, 0, 0] == -1
    with pytest.raises(ValueError, match="read-only"):
        grid.source[0, 0] = 0


def test_displacement_is_a_mean_length() -> None:
    """A shift by 3 and 4 hundredths displaces by 5."""
    assert Grid.from_map(lambda target: target + np.array([0.03, 0.04])).displacement == pytest.approx(0.05, abs=1e-6)
    assert Grid.identity().displacement == pytest.approx(0, abs=1e-7)


def test_the_lattice_lies_where_it_says() -> None:
    """source[r, c] belongs to target (2c/(columns-1)-1, 2r/(rows-1)-1): a shift right is seen in x, of columns."""
    grid = Grid.from_map(lambda target: target * [0.5, 0.25], 3, 5)
    assert grid.source.shape == (3, 5, 2)
    np.testing.assert_allclose(grid.source[2, 1], [-0.25, 0.25])
    assert error_px(grid, lambda target: target * [0.5, 0.25]).max() < 1e-4
