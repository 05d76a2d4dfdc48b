from __future__ import annotations

import cv2
import numpy as np
import pytest

from unbend_service.adapters.estimators.chains import EdgeChains, extract, fit_long_side
from unbend_service.application.ports import Bytes


def disc(side: int = 256, radius: float = 80.3, centre: tuple[float, float] = (128.2, 127.6)) -> Bytes:
    """A white disc on black; centre and radius in pixels, pixel centres at .5."""
    steps = np.arange(side) + 0.5
    distance = np.hypot(steps[None, :] - centre[0], steps[:, None] - centre[1])
    return np.asarray(np.clip(radius - distance + 0.5, 0, 1) * 200 + 20, np.uint8)


def sizes(chains: EdgeChains) -> list[int]:
    return np.diff(np.append(np.flatnonzero(chains.starts), len(chains.x))).tolist()


def test_points_lie_on_a_curved_edge_to_a_tenth_of_a_pixel() -> None:
    """A curved edge is found where it is, to sub-pixel precision, as one ordered chain."""
    chains = extract(disc(radius=150.3, centre=(128.2, 250.6)))
    x, y = (chains.x + 1) * 128, (chains.y + 1) * 128
    error = np.hypot(x - 128.2, y - 250.6) - 150.3
    step = np.hypot(np.diff(x), np.diff(y))
    assert max(sizes(chains)) > 80
    assert np.abs(error).mean() < 0.1
    assert step[~chains.starts[1:]].max() < 6


def test_a_curve_that_returns_to_itself_is_left_out() -> None:
    """A ring cannot have been straight."""
    assert extract(disc()).count == 0


def test_a_rectangle_is_split_at_its_corners() -> None:
    """Each side of a rectangle is a chain of its own, straight to a fraction of a pixel."""
    picture = np.full((256, 256), 40, np.uint8)
    cv2.rectangle(picture, (60, 50), (200, 190), 210, -1)
    chains = extract(picture)
    assert chains.count == 4
    for first, size in zip(np.flatnonzero(chains.starts), sizes(chains), strict=True):
        x, y = chains.x[first : first + size], chains.y[first : first + size]
        assert min(np.ptp(x), np.ptp(y)) * 128 < 0.3


def test_the_frame_is_isotropic_and_knows_the_picture() -> None:
    """A wide picture keeps its shape: the long side has length 2, and a circle stays round."""
    picture = np.full((200, 400), 20, np.uint8)
    picture[:, 100:300] = disc(200, 110.0, (100.0, 100.0))
    chains = extract(picture)
    inner = np.abs(chains.x) < 0.45  # the picture that the disc was pasted from ends at 0.5
    assert (chains.half_width, chains.half_height, chains.pixel) == (1.0, 0.5, 1 / 200)
    assert inner.sum() > 20
    assert np.hypot(chains.x, chains.y)[inner] == pytest.approx(110 / 200, abs=0.003)


@pytest.mark.parametrize("shape", [(1, 1), (5, 300), (64, 64)])
def test_a_blank_picture_of_any_size_has_no_chains(shape: tuple[int, int]) -> None:
    """Nothing to see gives nothing, not an error."""
    chains = extract(np.full(shape, 99, np.uint8))
    assert chains.count == 0
    assert len(chains.x) == 0


def test_pictures_are_reduced_but_never_enlarged() -> None:
    """Reduction keeps the aspect to within a pixel."""
    assert fit_long_side(np.zeros((1080, 1920), np.uint8), 384).shape == (216, 384)
    assert fit_long_side(np.zeros((100, 90), np.uint8), 384).shape == (100, 90)
