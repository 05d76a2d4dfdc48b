from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from tests.domain.lenses import BARREL, PINCUSHION, WAVE, projective, radial, rotation, shear, wave
from unbend_service.domain.errors import FoldedGrid, InvalidGrid, InvalidGuides, InvalidOption
from unbend_service.domain.fit import CROP, FULL, KEEP, Fit, with_fit, with_strength
from unbend_service.domain.fitting import guides_from_map
from unbend_service.domain.grid import Grid, folded_share
from unbend_service.domain.guides import DEFAULT_ANCHORS, GuideFamily, Guides
from unbend_service.domain.homography import without_plane_part
from unbend_service.domain.maps import BackwardMap, Float64, target_lattice


@st.composite
def maps(draw: st.DrawFn) -> BackwardMap:
    """A wave after a rotation after a perspective, scaled and shifted, each anything from nothing to strong."""
    turn, tilt = rotation(draw(st.floats(-45, 45))), projective(draw(st.floats(0.0, 0.2)))
    swing = wave(draw(st.floats(-WAVE, WAVE)))
    size, shift = draw(st.floats(0.7, 1.5)), np.array([draw(st.floats(-0.3, 0.3)), draw(st.floats(-0.3, 0.3))])
    return lambda target: swing(turn(tilt(target * size + shift)))


@st.composite
def lenses(draw: st.DrawFn) -> BackwardMap:
    """What an estimator would say of a lens, turned a little; with or without its plane part."""
    lens = radial(draw(st.floats(BARREL, PINCUSHION)), draw(st.floats(-0.1, 0.1)))
    guides = guides_from_map(lens, points=15, polish=0)
    turn = rotation(draw(st.floats(-10, 10)))
    turned: BackwardMap = lambda target: guides(turn(target))  # noqa: E731 - a nested def cannot be told its type
    return draw(st.sampled_from([turned, without_plane_part(guides)]))


def window(grid: Grid, fitted: Grid) -> tuple[float, float, float]:
    """Centre and half extent of the window of a fitted rotation about the middle, from its sources."""
    turned = np.linalg.lstsq(
        np.column_stack([target_lattice(65, 65).reshape(-1, 2), np.ones(65 * 65)]),
        fitted.source.reshape(-1, 2),
        rcond=None,
    )[0]
    return float(turned[2, 0]), float(turned[2, 1]), float(np.sqrt(np.linalg.det(turned[:2])))


def uniform(points: int = 401) -> Float64:
    return target_lattice(points, points)


@settings(max_examples=20)
@given(st.one_of(maps(), lenses()))
def test_crop_shows_no_gap(true: BackwardMap) -> None:
    """No lattice point of a crop lies outside the source, nor does any point between them."""
    cropped = with_fit(Grid.from_map(true), CROP)
    assert np.abs(cropped.source).max() <= 1
    assert np.abs(cropped(uniform())).max() <= 1 + 1e-12
    assert folded_share(cropped.source) == 0


@settings(max_examples=10)
@example(96)  # these two grow into a fold of the continuation when only the rim of the window is looked at
@example(159)
@given(st.integers(0, 2**32 - 1))
def test_the_crop_of_wild_guides_is_whole(seed: int) -> None:
    """Guides that no lens would have: what passes the fold check is cropped without a gap and without a fold."""
    rng = np.random.default_rng(seed)
    straight = GuideFamily.straight(DEFAULT_ANCHORS, 3).coefficients
    rows, columns = (
        GuideFamily(DEFAULT_ANCHORS, straight + rng.normal(0, 0.05, straight.shape) * [1, 0.7, 0.5, 0.3])
        for _ in range(2)
    )
    try:
        grid = Grid.from_map(Guides(rows, columns))
        grid.check_unfolded()
    except (InvalidGuides, FoldedGrid):
        return
    for fit in (CROP, FULL):
        fitted = with_fit(grid, fit)
        assert folded_share(fitted.source) == 0
        assert fit is FULL or np.abs(fitted(uniform(101))).max() <= 1 + 1e-12


@settings(max_examples=20)
@given(maps(), st.sampled_from([(2, 2), (2, 9), (9, 2), (3, 3), (33, 17)]))
def test_crop_shows_no_gap_on_small_lattices(true: BackwardMap, shape: tuple[int, int]) -> None:
    """However few points a lattice has, the guarantee holds, and the lattice keeps its shape."""
    grid = Grid.from_map(true, *shape)
    assume(folded_share(grid.source) == 0)
    cropped = with_fit(grid, CROP)
    assert (cropped.rows, cropped.columns) == shape
    assert np.abs(cropped(uniform(101))).max() <= 1 + 1e-12


def test_crop_shows_no_gap_between_the_points_of_its_search() -> None:
    """A ripple finer than the search looks at does not slip through: every point of a fine lattice is asked."""
    turn = rotation(5)
    ripple: BackwardMap = lambda target: turn(target) + 0.001 * np.sin(128 * np.pi * target)  # noqa: E731 - as above
    cropped = with_fit(Grid.from_map(ripple, 513, 513), CROP)
    assert np.abs(cropped.source).max() <= 1


@pytest.mark.parametrize("degrees", [0.5, 5, -15, 30, 45])
def test_the_crop_of_a_rotation_is_the_largest(degrees: float) -> None:
    """A square turned by a holds an upright one of 1 / (cos a + sin a) of its size; the crop is that, within 1e-3."""
    angle = np.deg2rad(abs(degrees))
    grid = Grid.from_map(rotation(degrees))
    x, y, half = window(grid, with_fit(grid, CROP))
    assert half == pytest.approx(1 / (np.cos(angle) + np.sin(angle)), abs=1e-3)
    assert (x, y) == pytest.approx((0, 0), abs=2e-3)


def test_the_crop_of_a_shear_is_the_largest() -> None:
    """A square sheared by k holds an upright one of 1 / (1 + k) of its size."""
    cropped = with_fit(Grid.from_map(shear(0.4)), CROP)
    size = cropped.source[-1, 0, 1] - cropped.source[0, 0, 1]
    assert size / 2 == pytest.approx(1 / 1.4, abs=1e-3)


@pytest.mark.parametrize("inset", [0.05, 0.1, 0.2])
def test_the_crop_of_a_trapezoid_is_the_largest(inset: float) -> None:
    """The largest upright square in a trapezoid hangs from its long side; its size follows from similar triangles."""
    low, high, top = 0.99, -0.99, 1.0
    narrow = 1 - 2 * inset
    # a square of half h with its upper side on the long side: its lower corners (h, high + 2h) lie on the slanted side
    half = (top - 0) / (1 + 2 * (top - narrow) / (low - high))
    grid = Grid.from_map(projective(inset))
    cropped = with_fit(grid, CROP)
    found = np.interp(0.0, [cropped.source[0, 0, 0], cropped.source[0, -1, 0]], [-1, 1])
    assert found == pytest.approx(0, abs=1e-3)
    at_top = (cropped.source[0, -1, 0] - cropped.source[0, 0, 0]) / 2
    assert at_top == pytest.approx(half, abs=2e-3)


@pytest.mark.parametrize("strength", [BARREL / 2, 0.1, 0.2, 0.3])
def test_the_crop_of_a_lens_is_the_largest(strength: float) -> None:
    """A barrel is cut at the middle of its sides, a pincushion at its corners; within 0.5 % of the picture."""
    half = 1 / (1 + strength) if strength < 0 else 1 / (1 + 2 * strength)
    cropped = with_fit(Grid.from_map(_visible(radial(strength))), CROP)
    row = cropped.source[32, :, 0].astype(float)
    at_side = row[-1] / (1 + strength * row[-1] ** 2)  # target of the middle of the right side
    assert at_side == pytest.approx(half, abs=0.01)


def _visible(true: BackwardMap) -> BackwardMap:
    """Far out where there is no source."""

    def backward(target: Float64) -> Float64:
        return np.where(np.isnan(source := true(target)), 4 * np.sign(target), source)

    return backward


@settings(max_examples=10)
@given(maps())
def test_full_shows_every_source_pixel(true: BackwardMap) -> None:
    """Every point of the source's border is met by the window, where the plane that is searched holds it."""
    grid = Grid.from_map(true)
    assume(folded_share(grid.source) == 0)
    plane = grid(target_lattice(201, 201, 1.9))
    rim = np.concatenate([plane[0], plane[-1], plane[:, 0], plane[:, -1]])
    assume((np.abs(rim).max(axis=-1) > 1).all() and folded_share(plane) == 0)
    shown = with_fit(grid, FULL)(uniform(161)).reshape(-1, 2)
    side = np.linspace(-1, 1, 9)
    border = np.array([(x, y) for x in side for y in side if max(abs(x), abs(y)) == 1])
    nearest = np.sqrt(((border[:, None] - shown[None]) ** 2).sum(axis=-1).min(axis=1))
    assert nearest.max() < 0.03


@pytest.mark.parametrize("degrees", [5, 30])
def test_the_full_view_of_a_rotation_is_the_smallest(degrees: float) -> None:
    """A turned square is held by an upright one cos a + sin a times its size, and by no smaller one."""
    angle = np.deg2rad(degrees)
    grid = Grid.from_map(rotation(degrees))
    _, _, half = window(grid, with_fit(grid, FULL))
    assert half == pytest.approx(np.cos(angle) + np.sin(angle), abs=1e-3)


@pytest.mark.parametrize("strength", [BARREL / 2, BARREL, 0.2, PINCUSHION])
def test_full_never_shows_garbage(strength: float) -> None:
    """Of a lens, the full view shows the source once: nothing folds back, no second picture appears outside."""
    grid = Grid.from_map(guides_from_map(radial(strength), points=25, polish=0))
    fitted = with_fit(grid, FULL)
    assert folded_share(fitted.source) == 0
    visible = np.abs(fitted.source).max(axis=-1) <= 1
    for line in (
        *visible,
        *visible.T,
    ):  # what is seen of each lattice line is one piece, or has the bow of a pincushion
        assert np.count_nonzero(np.diff(line.astype(int))) <= 4


@settings(max_examples=7)
@given(maps(), st.floats(0.1, 0.9))
def test_numbers_lie_between_crop_and_full(true: BackwardMap, share: float) -> None:
    """A fit number shows at least what crop shows and at most what full shows, and more the larger it is."""
    grid = Grid.from_map(true)
    assume(folded_share(grid.source) == 0)

    def gaps(fit: Fit) -> float:
        return float((np.abs(with_fit(grid, fit)(uniform(101))) > 1).any(axis=-1).mean())

    assert gaps(CROP) == 0
    assert gaps(Fit(share / 2)) <= gaps(Fit(share)) + 0.01
    assert gaps(Fit(share)) <= gaps(FULL) + 0.01


@pytest.mark.parametrize("fit", [KEEP, CROP, FULL, Fit(0.3)])
@pytest.mark.parametrize("shape", [(2, 2), (65, 65), (33, 9)])
def test_the_identity_stays_the_identity(fit: Fit, shape: tuple[int, int]) -> None:
    """A picture that needs no correction is not resampled by any fit."""
    assert with_fit(Grid.identity(*shape), fit).id == Grid.identity(*shape).id


@pytest.mark.parametrize("fit", [CROP, FULL, Fit(0.5)])
def test_next_to_nothing_stays_next_to_nothing(fit: Fit) -> None:
    """A displacement of a hundredth of a pixel at 256 makes no fit move more than a tenth."""
    grid = with_fit(Grid.from_map(rotation(0.004)), fit)
    assert grid.displacement < 0.1 * 2 / 256


def test_keep_keeps() -> None:
    """The frame as estimated is the very grid."""
    grid = Grid.from_map(rotation(5))
    assert with_fit(grid, KEEP) is grid


@pytest.mark.parametrize("fit", [CROP, FULL, Fit(0.5)])
@pytest.mark.parametrize("true", [lambda target: target + 9, lambda target: target * 0 + 3])
def test_a_grid_out_of_sight_is_refused(true: BackwardMap, fit: Fit) -> None:
    """There is no window on a source that is nowhere shown."""
    with pytest.raises(InvalidGrid, match="shows the source"):
        with_fit(Grid.from_map(true), fit)


def test_mirrored_grids_are_fitted_alike() -> None:
    """A mirrored map has the mirrored crop and full view."""
    mirrored: Callable[[Float64], Float64] = lambda target: wave(0.2)(target) * [-1, 1]  # noqa: E731 - as above
    for fit in (CROP, FULL):
        one, other = with_fit(Grid.from_map(wave(0.2)), fit), with_fit(Grid.from_map(mirrored), fit)
        np.testing.assert_allclose(one.source * [-1, 1], other.source, atol=2e-3)


@settings(max_examples=20)
@given(maps(), st.floats(0, 1), st.floats(0, 1))
def test_strength_blends(true: BackwardMap, first: float, second: float) -> None:
    """0 is the identity, 1 the grid itself, and the displacement grows in proportion."""
    grid = Grid.from_map(true)
    assert with_strength(grid, 0).id == Grid.identity().id
    assert with_strength(grid, 1) is grid
    for strength in (first, second):
        assert with_strength(grid, strength).displacement == pytest.approx(strength * grid.displacement, abs=1e-6)


@pytest.mark.parametrize("strength", [-0.01, 1.01, float("nan"), float("inf")])
def test_strengths_out_of_range_are_refused(strength: float) -> None:
    """Only 0..1 is a share."""
    with pytest.raises(InvalidOption, match="strength"):
        with_strength(Grid.identity(3, 3), strength)


@pytest.mark.parametrize(
    ("text", "fit"), [("keep", KEEP), ("crop", CROP), ("full", FULL), ("0.5", Fit(0.5)), ("0", CROP)]
)
def test_fits_are_read_and_written(text: str, fit: Fit) -> None:
    """The names and the numbers of the interface; what is written is read again."""
    assert Fit.parse(text) == fit
    assert Fit.parse(str(fit)) == fit


@pytest.mark.parametrize("text", ["", "CROP", "-0.1", "1.1", "nan", "inf", "half", "0,5"])
def test_unknown_fits_are_refused(text: str) -> None:
    """Anything else is named, with what would have been allowed."""
    with pytest.raises(InvalidOption, match="keep, crop, full"):
        Fit.parse(text)
