"""Who is let in, how often, and with how many streams."""

from __future__ import annotations

import asyncio
import hmac
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

from unbend_service.application.ports import Meter, TokenSource
from unbend_service.domain.access import Grant, Scope, digest_of
from unbend_service.domain.errors import PermissionDenied, RateLimited, TooManyStreams, Unauthenticated, UnbendError

_LONGEST_TOKEN = 256
_SEND_A_TOKEN = "`Authorization: Bearer` and a token of this service"


@dataclass(slots=True)
class Bucket:
    """A token bucket: ``rate_per_s`` on the long run, ``burst`` at once. A rate of None bounds nothing."""

    rate_per_s: float | None
    burst: int
    clock: Callable[[], float] = time.monotonic
    _level: float = field(init=False)
    _at_s: float = field(init=False)

    def __post_init__(self) -> None:
        self._level, self._at_s = float(self.burst), self.clock()

    def limit(self, rate_per_s: float | None, burst: int) -> None:
        """Other limits from now on; what was taken stays taken."""
        self._refill()
        self.rate_per_s, self.burst = rate_per_s, burst
        self._level = min(self._level, burst)

    def take(self) -> float:
        """Takes one and returns 0, or takes none and returns the seconds after which there will be one."""
        if self.rate_per_s is None:
            return 0.0
        self._refill()
        if self._level >= 1:
            self._level -= 1
            return 0.0
        return (1 - self._level) / self.rate_per_s

    def _refill(self) -> None:
        now = self.clock()
        self._level = min(self.burst, self._level + (now - self._at_s) * (self.rate_per_s or 0.0))
        self._at_s = now


@dataclass(slots=True, eq=False)
class Caller:
    """Whoever calls; all tokens of one name are one caller.

    Attributes:
        name: of the token; empty where none is asked for.
        streams: that may be open at once; None bounds nothing.
        open_streams: what ends each of them.
    """

    name: str
    bucket: Bucket
    streams: int | None
    open_streams: set[_OpenStream] = field(default_factory=set)

    async def frame(self) -> None:
        """Waits until another frame of a stream may be taken: a stream over its rate is slowed down, not refused."""
        while (pause_s := self.bucket.take()) > 0:  # noqa: ASYNC110 time is all that is waited for
            await asyncio.sleep(pause_s)


@dataclass(slots=True, eq=False)
class _OpenStream:
    """A stream of a caller, ended when the token that opened it is taken back."""

    digest: bytes
    scope: Scope
    owner: asyncio.Task[object]
    revoked: bool = False


@dataclass(frozen=True, slots=True)
class Permit:
    """A call that was let in: whose it is, and by which token."""

    caller: Caller
    scope: Scope
    digest: bytes = b""


class Access:
    """Checks tokens, scopes and the limits of each caller.

    Args:
        source: the tokens; None lets everybody in.
        rate_per_s, burst, streams: of callers whose line in the tokens file says nothing else.
        on_broken: told of tokens that cannot be read any more; those known before stay.
    """

    def __init__(
        self,
        source: TokenSource | None,
        meter: Meter,
        *,
        rate_per_s: float | None = None,
        burst: int = 1,
        streams: int | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._source = source
        self._meter = meter
        self._rate_per_s = rate_per_s
        self._burst = burst
        self._streams = streams
        self._clock = clock
        self._anybody = Caller("", Bucket(None, 1, clock), None)
        self._grants: Sequence[Grant] = ()
        self._callers: dict[str, Caller] = {}
        if source is not None:
            self._apply(source.read() or ())

    @property
    def required(self) -> bool:
        """Whether callers have to show a token."""
        return self._source is not None

    def admit(self, token: str | None, scope: Scope) -> Permit:
        """Lets a call in, and counts it against the rate of its caller.

        Raises:
            Unauthenticated: no token, or one that is not known.
            PermissionDenied: the token is not for this.
            RateLimited: too many calls of this caller.
        """
        if self._source is None:
            return Permit(self._anybody, scope)
        try:
            grant = self._known(token)
            if not grant.allows(scope):
                raise PermissionDenied(
                    f"The token {grant.name} is not for this.", allowed=f"a token of the scope {scope}"
                )
            caller = self._callers[grant.name]
            if (pause_s := caller.bucket.take()) > 0:
                raise RateLimited(
                    f"{grant.name} is over its rate.",
                    allowed=f"{caller.bucket.rate_per_s:g} a second, {caller.bucket.burst} at once",
                    setting="token_rate_per_s",
                    retry_after_s=round(max(0.001, pause_s), 3),
                )
        except UnbendError as error:
            self._meter.rejected(error.code)
            raise
        return Permit(caller, scope, grant.digest)

    @contextmanager
    def stream(self, permit: Permit) -> Iterator[None]:
        """Around a stream; the task that enters is cancelled if the token is taken back.

        Raises:
            TooManyStreams: as many as this caller may have are open.
            Unauthenticated: the token was taken back meanwhile.
        """
        caller, owner = permit.caller, asyncio.current_task()
        assert owner is not None
        if caller.streams is not None and len(caller.open_streams) >= caller.streams:
            self._meter.rejected(TooManyStreams.code)
            raise TooManyStreams(
                f"{caller.name} has {len(caller.open_streams)} streams open.",
                allowed=str(caller.streams),
                setting="token_streams",
                retry_after_s=1.0,
            )
        stream = _OpenStream(permit.digest, permit.scope, owner)
        caller.open_streams.add(stream)
        try:
            yield
        except asyncio.CancelledError:
            if not stream.revoked or owner.uncancel() > 0:
                raise
            raise Unauthenticated("The token was taken back.", allowed=_SEND_A_TOKEN) from None
        finally:
            caller.open_streams.discard(stream)

    async def refresh(self) -> bool:
        """Reads the tokens again if they changed, and ends the streams of those that are gone.

        Returns:
            Whether they changed.

        Raises:
            InvalidOption, OSError: they cannot be read any more, told once; those known before stay.
        """
        if self._source is None:
            return False
        grants = await asyncio.to_thread(self._source.read)
        if grants is not None:
            self._apply(grants)
        return grants is not None

    def _known(self, token: str | None) -> Grant:
        if not token:
            raise Unauthenticated("No token was sent.", allowed=_SEND_A_TOKEN)
        digest = digest_of(token[:_LONGEST_TOKEN])
        found = None
        for grant in self._grants:  # all of them, however early one fits: the time it takes says nothing
            if hmac.compare_digest(grant.digest, digest):
                found = grant
        if found is None:
            raise Unauthenticated("The token is not known here.", allowed=_SEND_A_TOKEN)
        return found

    def _apply(self, grants: Sequence[Grant]) -> None:
        before, self._grants, self._callers = self._callers, grants, {}
        for grant in grants:
            rate_per_s = grant.rate_per_s or self._rate_per_s
            burst, streams = grant.burst or self._burst, grant.streams or self._streams
            caller = before.get(grant.name) or Caller(grant.name, Bucket(rate_per_s, burst, self._clock), streams)
            caller.bucket.limit(rate_per_s, burst)
            caller.streams = streams
            self._callers[grant.name] = caller
        good = {grant.digest: grant for grant in grants}
        for caller in before.values():
            for stream in caller.open_streams:
                grant_now = good.get(stream.digest)
                if not stream.revoked and (grant_now is None or not grant_now.allows(stream.scope)):
                    stream.revoked = True
                    stream.owner.cancel()
