from __future__ import annotations

import cv2
import numpy as np
import pytest

from training.scenes import HEIGHT_PX, WIDTH_PX
from training.vistas import draw_scene
from training.vistas.materials import Material, plain
from training.vistas.raster import Camera, Raster
from training.vistas.silhouettes import person
from training.vistas.sites import Site
from unbend_service.adapters.estimators.chains import EdgeChains, extract

SCENES = [draw_scene(np.random.default_rng([3, number])) for number in range(8)]


def raster(heading: float = 0.0, horizon_px: float = HEIGHT_PX) -> Raster:
    """An empty picture of twice the size, seen from a metre and a half above the floor."""
    camera = Camera(np.array([0.0, 1.5, 0.0]), heading, 1.1 * WIDTH_PX * 2, horizon_px)
    return Raster(WIDTH_PX * 2, HEIGHT_PX * 2, camera, np.array([0.3, 1.0, -0.8]), 0.6)


def bows_px(picture: np.ndarray, shortest_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Length of each longer chain and how far its points are from a straight line, root mean square, in pixels."""
    chains: EdgeChains = extract(picture)
    points = np.stack([chains.x, chains.y], 1) * max(picture.shape) / 2
    lengths, bows = [], []
    for chain in np.split(points, np.flatnonzero(chains.starts)[1:]):
        length = float(np.hypot(*np.diff(chain, axis=0).T).sum())
        if length > shortest_px:
            lengths.append(length)
            bows.append(np.linalg.svd(chain - chain.mean(0), compute_uv=False)[1] / np.sqrt(len(chain)))
    return np.array(lengths), np.array(bows)


def test_a_scene_comes_again_from_its_seed_and_no_other_does() -> None:
    """A chain store can be made again; two seeds never give one picture."""
    again = draw_scene(np.random.default_rng([3, 0]))
    np.testing.assert_array_equal(again, SCENES[0])
    assert again.shape == (HEIGHT_PX, WIDTH_PX)
    assert again.dtype == np.uint8
    assert len({scene.tobytes() for scene in SCENES}) == len(SCENES)


@pytest.mark.parametrize("heading", [0.0, 0.4, -0.9])
@pytest.mark.parametrize("horizon_px", [HEIGHT_PX * 0.8, HEIGHT_PX * 1.3])
def test_straight_edges_are_drawn_where_central_projection_puts_them(heading: float, horizon_px: float) -> None:
    """The labels say that nothing is bent: what is found on blocks and slanting boards runs along the straight lines
    between their projected corners, to a tenth of a pixel."""
    drawn = raster(heading, horizon_px)
    drawn.tone[:] = 0.9
    corners = np.array([(s, t, out) for s in (-0.6, 0.6) for t in (0.0, 2.2) for out in (-0.4, 0.4)])
    board = np.array([(-1.0, 2.6, 0.0), (1.0, 3.3, 0.0), (1.0, 3.0, 0.0), (-1.0, 2.3, 0.0)])
    lines = []
    for x, z, turn in ((-2.0, 4.0, 0.3), (0.4, 3.5, -0.5), (3.0, 5.0, 0.9), (-4.0, 5.0, 0.1), (4.0, 3.0, 0.2)):
        site = Site.facing(drawn, (x, 0.0, z), np.pi + turn)
        site.box((-0.6, 0.6), (0.0, 2.2), (-0.4, 0.4), plain(0.5))
        site.face([tuple(corner) for corner in board.tolist()], plain(0.1))
        for points, pairs in (
            (corners, [(a, a ^ bit) for a in range(8) for bit in (1, 2, 4)]),
            (board, [(0, 1), (1, 2), (2, 3), (3, 0)]),
        ):
            sight = site.world(points) - (0.0, 1.5, 0.0)
            right = sight @ (np.cos(heading), 0.0, -np.sin(heading))
            ahead = sight @ (np.sin(heading), 0.0, np.cos(heading))
            seen = np.stack([right, -sight[:, 1]], 1) / ahead[:, None] * 1.1 * WIDTH_PX + (WIDTH_PX / 2, horizon_px / 2)
            lines += [(seen[a], seen[b]) for a, b in pairs if min(ahead[a], ahead[b]) > 0.2]
    grey = cv2.GaussianBlur(cv2.resize(drawn.tone, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_AREA), (0, 0), 0.6)
    found = extract((grey.clip(0, 1) * 255).astype(np.uint8))
    points = np.stack([found.x, found.y], 1) * WIDTH_PX / 2 + (WIDTH_PX / 2, HEIGHT_PX / 2)
    beside, nearest = np.full(len(points), np.inf), np.full(len(points), -1)
    for number, (start, end) in enumerate(lines):
        ahead_px = float(np.hypot(*(end - start)))
        unit = (end - start) / ahead_px
        along, across = (points - start) @ unit, (points - start) @ (-unit[1], unit[0])
        closer = (along > 3) & (along < ahead_px - 3) & (np.abs(across) < np.abs(beside))
        beside[closer], nearest[closer] = across[closer], number
    assert len(points) > 300
    assert np.mean(np.abs(beside) < 0.5) > 0.9
    spread = [
        np.ptp(np.percentile(beside[nearest == n], (5, 95))) for n in range(len(lines)) if (nearest == n).sum() > 40
    ]
    assert len(spread) >= 4
    assert np.quantile(spread, 0.75) < 0.12  # where two edges meet, chains cut the corner


def test_what_is_nearer_hides_what_is_behind_it_in_whatever_order_they_are_drawn() -> None:
    """Pieces of furniture may stand in, on and behind each other."""

    def drawn(order: list[int]) -> np.ndarray:
        picture = raster(0.3)
        for number in order:
            site = Site.facing(picture, (0.3 * number, 0.0, 3.0 + 0.35 * number), np.pi + 0.4 * number)
            site.box((-0.8, 0.8), (0.0, 1.0 + 0.3 * number), (-0.5, 0.5), plain(0.1 + 0.2 * number))
        return picture.tone

    np.testing.assert_array_equal(drawn([0, 1, 2, 3]), drawn([3, 1, 0, 2]))


def test_a_box_around_the_camera_is_not_in_its_way() -> None:
    """Sides are seen from outside only, and what is behind the camera not at all."""
    picture = raster()
    Site.facing(picture, (0.0, 0.0, 0.0), np.pi).box((-1, 1), (0, 3), (-1, 1), plain(0.5))
    assert not picture.nearness.any()


def test_people_show_what_is_behind_between_their_limbs() -> None:
    """A silhouette covers itself and nothing else of its panel, so that a straight edge goes on beside it."""
    picture = raster()
    behind = Site.facing(picture, (-5.0, 0.0, 6.0), np.pi)
    behind.panel((0.0, 10.0), (0.0, 5.0), 0.0, plain(2.0))
    somebody = person(np.random.default_rng(1))
    Site.facing(picture, (0.0, 0.0, 3.0), np.pi).panel((-0.4, 0.4), (0.0, 1.8), 0.0, somebody)
    assert somebody.cover is not None
    nearer = picture.nearness > 1 / 4
    wall = picture.tone[HEIGHT_PX, 10]
    assert 0.5 * somebody.cover.mean() < nearer[HEIGHT_PX:, WIDTH_PX - 300 : WIDTH_PX + 300].mean() < 0.7
    corner = picture.tone[int(HEIGHT_PX * 0.88), WIDTH_PX - 180]
    assert corner == wall


def test_textures_keep_their_size_in_metres() -> None:
    """Twice as far away a tile is half as wide, and is not smeared over its wall."""
    stripes = Material(
        np.asarray(np.sign(np.sin(np.arange(256) * 2 * np.pi / 64))[None].repeat(256, 0), np.float32), 1.0
    )
    periods = []
    for distance in (2.0, 4.0):
        picture = raster()
        Site.facing(picture, (-9.0, 0.0, distance), np.pi).face([(0, 3, 0), (18, 3, 0), (18, 0, 0), (0, 0, 0)], stripes)
        edges = np.abs(np.diff(np.sign(picture.tone[HEIGHT_PX]))).sum() / 2
        periods.append(4 * WIDTH_PX / edges)
    assert periods[0] == pytest.approx(2 * periods[1], rel=0.05)
    assert periods[1] == pytest.approx(1.1 * WIDTH_PX * 2 / 4 / 4, rel=0.05)


def test_scenes_show_a_lens_about_as_much_as_photographs_do() -> None:
    """Chains are as many as in photographs, and most of the long ones straight, but not all: photographs show plants,
    people and cables too. (Of real photographs 80 to 95 % of the length of long chains is straight.)"""
    shares, counts = [], []
    for scene in SCENES:
        lengths, bows = bows_px(scene, 50)
        straight = bows < 0.3 + 0.004 * lengths
        shares.append(float(lengths[straight].sum() / lengths.sum()))
        counts.append(int(extract(scene).starts.sum()))
    assert 60 < np.median(counts) < 400
    assert np.median(shares) > 0.8
    assert min(shares) < 0.99
