"""Pictures that name their camera."""

from __future__ import annotations

import asyncio
import dataclasses

import numpy as np
import pytest

from tests.fakes import FAKE_MODEL, RecordingMeter, barrel_guides
from unbend_service.adapters.grid_stores.memory import MemoryGridStore
from unbend_service.application.blocking import BlockingWork
from unbend_service.application.cameras import Cameras
from unbend_service.application.ports import Estimate
from unbend_service.domain.camera_record import ENOUGH_LOOKS, MOST_LOOKS
from unbend_service.domain.errors import GridNotFound, InvalidOption
from unbend_service.domain.maps import target_lattice
from unbend_service.settings import Settings


def estimate(bend: float = 0.06, error: float = 0.02) -> Estimate:
    return Estimate(barrel_guides(bend), 0.7, "calibrated_probability", FAKE_MODEL, error)


@pytest.fixture
def store() -> MemoryGridStore:
    return MemoryGridStore(Settings())


@pytest.fixture
def cameras(store: MemoryGridStore) -> Cameras:
    return Cameras(store, BlockingWork(2, 64, RecordingMeter()), FAKE_MODEL)


async def test_several_pictures_are_nearer_to_the_lens_than_one(cameras: Cameras) -> None:
    bends = 0.06 + np.random.default_rng(2).normal(0, 0.01, 8)
    for number, bend in enumerate(bends):
        together = await cameras.add("dashcam", 1.5, estimate(float(bend)), f"p{number}")

    target = target_lattice(9, 9, 0.8)
    off = np.abs(together.guides(target) - barrel_guides(0.06)(target)).max()
    alone = np.abs(barrel_guides(float(bends[-1]))(target) - barrel_guides(0.06)(target)).max()
    assert off < max(alone, 0.004)
    assert (together.expected_error or 1) < 0.02
    assert (await cameras.get("dashcam")).version == 8


async def test_cameras_are_kept_apart(cameras: Cameras) -> None:
    await cameras.add("left", 1.5, estimate(0.06), "p0")
    right = await cameras.add("right", 1.5, estimate(-0.05), "p1")

    assert np.allclose(right.guides.rows.coefficients, barrel_guides(-0.05).rows.coefficients)


async def test_pictures_that_come_at_the_same_time_all_count(cameras: Cameras) -> None:
    await asyncio.gather(*(cameras.add("busy", 1.5, estimate(), f"p{n}") for n in range(ENOUGH_LOOKS)))

    assert len((await cameras.get("busy")).looks) == ENOUGH_LOOKS


async def test_once_locked_no_picture_changes_the_grid(cameras: Cameras) -> None:
    for number in range(MOST_LOOKS):
        assert await cameras.locked("fixed", 1.5) is None
        last = await cameras.add("fixed", 1.5, estimate(0.06 + number % 3 / 100), f"p{number}")

    locked = await cameras.locked("fixed", 1.5)

    assert locked is not None
    assert np.array_equal(locked.guides.rows.coefficients, last.guides.rows.coefficients)


async def test_a_camera_that_is_reset_begins_anew(cameras: Cameras) -> None:
    await cameras.add("lens", 1.5, estimate(0.06), "p0")
    await cameras.reset("lens")

    with pytest.raises(GridNotFound, match="lens"):
        await cameras.get("lens")
    with pytest.raises(GridNotFound):
        await cameras.reset("lens")


async def test_another_model_does_not_mix_its_looks_with_those_of_the_last(store: MemoryGridStore) -> None:
    blocking = BlockingWork(2, 64, RecordingMeter())
    await Cameras(store, blocking, FAKE_MODEL).add("lens", 1.5, estimate(0.06), "p0")
    other = Cameras(store, blocking, dataclasses.replace(FAKE_MODEL, name="other"))

    await other.add("lens", 1.5, estimate(0.02), "p1")

    record = await other.get("lens")
    assert (record.model, record.version, len(record.looks)) == ("other", 2, 1)


async def test_pictures_of_other_proportions_are_refused(cameras: Cameras) -> None:
    await cameras.add("lens", 1.5, estimate(), "p0")

    with pytest.raises(InvalidOption, match="aspect"):
        await cameras.add("lens", 2 / 3, estimate(), "p1")
