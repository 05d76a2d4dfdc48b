from __future__ import annotations

import asyncio

import numpy as np
import pytest

from tests.application.conftest import Application
from unbend_service.application.known import Known, digest
from unbend_service.domain.frames import Frame, PixelFormat


class Computation:
    """Counts how often it is asked, and answers when it may."""

    def __init__(self) -> None:
        self.asked = 0
        self.may_answer = asyncio.Event()
        self.failure: Exception | None = None

    async def __call__(self) -> int:
        self.asked += 1
        await self.may_answer.wait()
        if self.failure is not None:
            raise self.failure
        return self.asked


async def test_those_who_ask_at_once_share_one_computation() -> None:
    """However many ask for a content at the same time, it is computed once, and again only once forgotten."""
    known: Known[int] = Known(1)
    compute = Computation()
    asking = [asyncio.create_task(known.get(b"a", compute)) for _ in range(5)]
    await asyncio.sleep(0)
    compute.may_answer.set()
    assert await asyncio.gather(*asking) == [1] * 5
    assert await known.get(b"a", compute) == 1
    assert await known.get(b"b", compute) == 2
    assert await known.get(b"a", compute) == 3


async def test_who_goes_away_takes_nothing_from_the_others() -> None:
    """The one who asked first may be cancelled: those who wait with him get their answer."""
    known: Known[int] = Known(1)
    compute = Computation()
    first = asyncio.create_task(known.get(b"a", compute))
    await asyncio.sleep(0)
    second = asyncio.create_task(known.get(b"a", compute))
    await asyncio.sleep(0)
    first.cancel()
    compute.may_answer.set()
    assert await second == 1
    assert compute.asked == 1


async def test_the_last_who_goes_away_ends_the_computation() -> None:
    """Nothing is computed for nobody; who asks later has it computed anew."""
    known: Known[int] = Known(1)
    compute = Computation()
    asking = [asyncio.create_task(known.get(b"a", compute)) for _ in range(2)]
    await asyncio.sleep(0)
    for task in asking:
        task.cancel()
    await asyncio.gather(*asking, return_exceptions=True)
    await asyncio.sleep(0)
    assert len(asyncio.all_tasks()) == 1
    compute.may_answer.set()
    assert await known.get(b"a", compute) == 2


async def test_an_error_reaches_all_and_is_forgotten() -> None:
    """Nobody is told an old error: the next one who asks has it tried again."""
    known: Known[int] = Known(1)
    compute = Computation()
    compute.failure = ValueError("broken")
    compute.may_answer.set()
    answers = await asyncio.gather(*(known.get(b"a", compute) for _ in range(3)), return_exceptions=True)
    assert [str(answer) for answer in answers] == ["broken"] * 3
    compute.failure = None
    assert await known.get(b"a", compute) == 2


@pytest.mark.parametrize(("entries", "kept"), [(0, 0), (3, 3)])
async def test_what_is_known_is_bounded(entries: int, kept: int) -> None:
    """Never more is kept than was allowed, and what was asked for last is kept."""
    known: Known[int] = Known(entries)
    compute = Computation()
    compute.may_answer.set()
    for number in range(10):
        await known.get(bytes([number]), compute)
        assert len(known) <= entries
    assert len(known) == kept


def test_a_digest_tells_contents_apart() -> None:
    """One byte more or other is another content; an array counts as its bytes."""
    assert len({digest(b""), digest(b"a"), digest(b"b"), digest(b"aa")}) == 4
    assert digest(np.frombuffer(b"ab", np.uint8)) == digest(b"a", b"b") == digest(b"ab")


async def test_a_picture_is_looked_at_once(application: Application, jpeg: bytes) -> None:
    """The same file, whatever is asked of it and by how many at once, costs one estimate."""
    estimation = application.estimation
    await asyncio.gather(*(estimation.of_image(jpeg, strength=strength) for strength in (0.2, 0.4, 0.6, 0.8)))
    await estimation.of_image(jpeg, min_confidence=0.99)
    assert len(application.estimator.seen) == 1


async def test_the_same_bytes_in_another_layout_are_another_picture(application: Application) -> None:
    """Bytes that could be a wide or a tall picture are looked at as both."""
    data = np.zeros(64 * 32, np.uint8)
    for width, height in ((64, 32), (32, 64), (64, 32)):
        await application.estimation.of_frame(Frame(PixelFormat.GRAY8, width, height, data))
    assert application.estimator.seen == [(32, 64), (64, 32)]
