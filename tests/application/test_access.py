from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass, field

import pytest

from tests.fakes import RecordingMeter
from unbend_service.application.access import Access, Bucket
from unbend_service.domain.access import Grant, Scope, digest_of
from unbend_service.domain.errors import InvalidOption, PermissionDenied, RateLimited, TooManyStreams, Unauthenticated


@dataclass
class Clock:
    now: float = 0.0

    def __call__(self) -> float:
        return self.now


@dataclass
class Tokens:
    """Port TokenSource whose content is set by the test."""

    next: list[Grant] | InvalidOption | None = None

    def read(self) -> Sequence[Grant] | None:
        found, self.next = self.next, None
        if isinstance(found, InvalidOption):
            raise found
        return found


@dataclass
class Door:
    """Access with two tokens, and a clock that stands still."""

    clock: Clock = field(default_factory=Clock)
    meter: RecordingMeter = field(default_factory=RecordingMeter)

    def __post_init__(self) -> None:
        self.a = Grant("a", frozenset({Scope.CORRECT}), digest_of("secret-a"), rate_per_s=2.0, burst=3, streams=1)
        self.b = Grant("b", frozenset({Scope.GRIDS}), digest_of("secret-b"))
        self.tokens = Tokens([self.a, self.b])
        self.access = Access(self.tokens, self.meter, clock=self.clock)


@pytest.fixture
def door() -> Door:
    return Door()


def test_without_tokens_anybody_may_do_everything() -> None:
    access = Access(None, RecordingMeter())
    assert not access.required
    for scope in Scope:
        assert access.admit(None, scope).caller.name == ""


def test_an_empty_file_lets_nobody_in() -> None:
    access = Access(Tokens([]), RecordingMeter())
    assert access.required
    with pytest.raises(Unauthenticated):
        access.admit("secret-a", Scope.CORRECT)


def test_only_a_known_token_of_the_scope_is_let_in(door: Door) -> None:
    assert door.access.admit("secret-a", Scope.CORRECT).caller.name == "a"
    for token in (None, "", "secret", "secret-a ", "x" * 100_000):
        with pytest.raises(Unauthenticated):
            door.access.admit(token, Scope.CORRECT)
    with pytest.raises(PermissionDenied):
        door.access.admit("secret-a", Scope.GRIDS)
    assert door.meter.rejections == {"unauthenticated": 5, "permission_denied": 1}


def test_a_caller_has_its_burst_and_then_its_rate(door: Door) -> None:
    for _ in range(3):
        door.access.admit("secret-a", Scope.CORRECT)
    with pytest.raises(RateLimited) as failure:
        door.access.admit("secret-a", Scope.CORRECT)
    assert failure.value.retry_after_s == 0.5
    door.clock.now += 0.5
    door.access.admit("secret-a", Scope.CORRECT)
    door.clock.now += 3600
    for _ in range(3):
        door.access.admit("secret-a", Scope.CORRECT)
    with pytest.raises(RateLimited):
        door.access.admit("secret-a", Scope.CORRECT)
    door.access.admit("secret-b", Scope.GRIDS)  # has no rate


async def test_reading_the_tokens_again_gives_nobody_a_new_burst(door: Door) -> None:
    for _ in range(3):
        door.access.admit("secret-a", Scope.CORRECT)
    door.tokens.next = [door.a]
    assert await door.access.refresh()
    assert not await door.access.refresh()
    with pytest.raises(RateLimited):
        door.access.admit("secret-a", Scope.CORRECT)
    with pytest.raises(Unauthenticated):
        door.access.admit("secret-b", Scope.GRIDS)


async def test_tokens_that_cannot_be_read_leave_those_before(door: Door) -> None:
    door.tokens.next = InvalidOption("Broken.")
    with pytest.raises(InvalidOption):
        await door.access.refresh()
    door.access.admit("secret-a", Scope.CORRECT)


async def test_a_caller_has_its_streams_and_no_more(door: Door) -> None:
    permit = door.access.admit("secret-a", Scope.CORRECT)
    with door.access.stream(permit):
        with pytest.raises(TooManyStreams) as failure, door.access.stream(permit):
            pass
        assert failure.value.setting == "token_streams"
    with door.access.stream(permit):
        pass


async def test_a_stream_ends_when_its_token_is_taken_back_or_loses_its_scope(door: Door) -> None:
    started = asyncio.Event()

    async def stream() -> None:
        with door.access.stream(door.access.admit("secret-b", Scope.GRIDS)):
            started.set()
            await asyncio.sleep(60)

    for after in ([door.a], [door.a, Grant("b", frozenset({Scope.METRICS}), door.b.digest)]):
        task = asyncio.create_task(stream())
        await started.wait()
        door.tokens.next = after
        await door.access.refresh()
        with pytest.raises(Unauthenticated):
            await task
        started.clear()
        door.tokens.next = [door.a, door.b]
        await door.access.refresh()


async def test_a_stream_that_is_cancelled_by_others_is_cancelled(door: Door) -> None:
    async def stream() -> None:
        with door.access.stream(door.access.admit("secret-a", Scope.CORRECT)):
            await asyncio.sleep(60)

    task = asyncio.create_task(stream())
    await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task


def test_a_bucket_without_a_rate_bounds_nothing() -> None:
    bucket = Bucket(None, 1)
    assert [bucket.take() for _ in range(1000)] == [0.0] * 1000
