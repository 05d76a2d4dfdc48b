from __future__ import annotations

import fcntl
import os

import pytest

from tests.fakes import FakeRenderPool
from unbend_service.application.regions import Regions
from unbend_service.domain.errors import InvalidRegion, RegionNotFound, TooManyRegions

SIZE, FRAME = 1 << 16, 1000


def memfd(size_bytes: int = SIZE) -> int:
    fd = os.memfd_create("unbend-test-region", os.MFD_ALLOW_SEALING)
    os.ftruncate(fd, size_bytes)
    fcntl.fcntl(fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)
    return fd


@pytest.fixture
def regions() -> Regions:
    return Regions(FakeRenderPool(), 3 * SIZE)


@pytest.mark.parametrize(("source", "target"), [(0, FRAME), (SIZE - FRAME, 0), (17, SIZE - FRAME)])
def test_a_picture_is_the_bytes_that_were_named(regions: Regions, source: int, target: int) -> None:
    region_id = regions.register(memfd(), SIZE)
    picture = regions.picture(region_id, source, target, FRAME, FRAME)
    picture.memory.memory[source] = 7
    assert picture.source[0] == 7
    assert not picture.source.flags.writeable
    picture.target[-1] = 9
    assert picture.memory.memory[target + FRAME - 1] == 9


@pytest.mark.parametrize(
    ("source", "target", "size"),
    [
        (SIZE - FRAME + 1, 0, FRAME),
        (0, SIZE - FRAME + 1, FRAME),
        (2**64 - 1, 0, FRAME),
        (0, FRAME - 1, FRAME),
        (500, 500, FRAME),
        (0, FRAME, FRAME - 1),
        (0, FRAME, 2**63),
    ],
)
def test_whatever_is_not_inside_is_refused(regions: Regions, source: int, target: int, size: int) -> None:
    """Beyond the end, overlapping, or not of a frame's size: no byte is looked at."""
    region_id = regions.register(memfd(), SIZE)
    with pytest.raises(InvalidRegion):
        regions.picture(region_id, source, target, size, FRAME)


def test_a_region_smaller_than_a_frame_serves_none(regions: Regions) -> None:
    region_id = regions.register(memfd(), 100)
    with pytest.raises(InvalidRegion):
        regions.picture(region_id, 0, 0, FRAME, FRAME)


def test_ids_cannot_be_guessed_and_end_with_the_region(regions: Regions) -> None:
    first, second = regions.register(memfd(), SIZE), regions.register(memfd(), SIZE)
    assert first != second
    assert len(first) == 33
    regions.release(first)
    regions.release(first)
    for unknown in (first, "", "r0"):
        with pytest.raises(RegionNotFound):
            regions.picture(unknown, 0, FRAME, FRAME, FRAME)
    regions.picture(second, 0, FRAME, FRAME, FRAME)


def test_the_memory_of_all_clients_is_bounded(regions: Regions) -> None:
    with pytest.raises(InvalidRegion, match="local_memory_bytes"):
        regions.check_room(3 * SIZE + 1)
    with pytest.raises(InvalidRegion):
        regions.check_room(0)
    region_id = regions.register(memfd(), SIZE)
    regions.check_room(2 * SIZE)
    with pytest.raises(TooManyRegions, match="local_memory_bytes"):
        regions.check_room(2 * SIZE + 1)
    regions.release(region_id)
    regions.check_room(3 * SIZE)
