from __future__ import annotations

import fcntl
import gc
import itertools
import os
import tempfile
from collections.abc import Iterable

import numpy as np
import pytest

from unbend_service.adapters.renderers.regions import RegionKeeper
from unbend_service.domain.errors import InvalidRegion, RegionNotFound

SIZE = 8192
SHRINK = fcntl.F_SEAL_SHRINK


def memfd(seals: int = SHRINK, size_bytes: int = SIZE) -> int:
    fd = os.memfd_create("unbend-test-region", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    os.ftruncate(fd, size_bytes)
    fcntl.fcntl(fd, fcntl.F_ADD_SEALS, seals)
    return fd


class Keeper(RegionKeeper):
    def __init__(self) -> None:
        self.unmapped: list[int] = []
        super().__init__(itertools.count(1).__next__, self._note)

    def _note(self, numbers: Iterable[int]) -> None:
        self.unmapped.extend(numbers)


def is_open(fd: int) -> bool:
    try:
        os.fstat(fd)
    except OSError:
        return False
    return True


def test_what_the_client_writes_is_seen_and_what_we_write_it_sees() -> None:
    fd = memfd()
    theirs = os.dup(fd)
    region = Keeper().adopt(fd, SIZE)
    os.pwrite(theirs, b"frame", 100)
    assert region.memory[100:105].tobytes() == b"frame"
    region.memory[200:203] = np.frombuffer(b"abc", np.uint8)
    assert os.pread(theirs, 3, 200) == b"abc"
    os.close(theirs)
    region.close()


def test_memory_that_could_vanish_under_us_is_refused_and_its_descriptor_closed() -> None:
    """A file, a pipe, memory that may shrink or may not be written: none can be trusted not to kill or block us."""
    keeper = Keeper()
    with tempfile.TemporaryFile() as file:
        file.truncate(SIZE)
        read, write = os.pipe()
        refused = [os.dup(file.fileno()), read, memfd(fcntl.F_SEAL_GROW), memfd(SHRINK | fcntl.F_SEAL_WRITE)]
        for fd in refused:
            with pytest.raises(InvalidRegion):
                keeper.adopt(fd, SIZE)
            assert not is_open(fd)
        os.close(write)


def test_a_region_may_not_say_more_than_there_is() -> None:
    with pytest.raises(InvalidRegion, match=f"{SIZE} bytes, not {SIZE + 1}"):
        Keeper().adopt(memfd(), SIZE + 1)


def test_huge_pages_are_refused() -> None:
    """They run out, and whoever touches one that is not there is killed."""
    try:
        fd = os.memfd_create("unbend-test-huge", os.MFD_HUGETLB | os.MFD_ALLOW_SEALING)
        os.ftruncate(fd, 2 << 20)
    except OSError:
        pytest.skip("the system has no huge pages")
    fcntl.fcntl(fd, fcntl.F_ADD_SEALS, SHRINK)
    with pytest.raises(InvalidRegion, match="huge"):
        Keeper().adopt(fd, SIZE)


def test_a_region_is_closed_when_its_client_has_gone_and_no_frame_is_under_way() -> None:
    keeper = Keeper()
    region = keeper.adopt(memfd(), SIZE)
    region.enter()
    keeper.disown(region)
    assert keeper.unmapped == []
    assert is_open(region.fd)
    with pytest.raises(RegionNotFound):
        region.enter()
    keeper.leave(region)
    assert keeper.unmapped == [region.number]
    gc.collect()
    assert not is_open(region.fd)
    keeper.disown(region)  # once more does nothing
    with pytest.raises(RegionNotFound):
        keeper.known(region)


def test_closing_the_keeper_closes_what_is_in_use() -> None:
    keeper = Keeper()
    region = keeper.adopt(memfd(), SIZE)
    region.enter()
    keeper.close()
    gc.collect()
    assert not is_open(region.fd)
