"""When render workers die so often that something is wrong with all of them."""

from __future__ import annotations

from collections import deque

#: So many deaths within so many seconds are a storm.
STORM_DEATHS, STORM_WITHIN_S = 5, 60.0
_SHORTEST_BACKOFF_S, _LONGEST_BACKOFF_S = 0.2, 30.0


class StormGuard:
    """Remembers when workers died by a fault: a crash, a hang, or before they were of any use.

    A worker that did its work and was then killed from outside says nothing about its successor, and is not noted.
    """

    def __init__(self) -> None:
        self._deaths: deque[float] = deque(maxlen=64)
        self._cause = ""

    def note(self, now_s: float, cause: str) -> None:
        """A worker died by a fault at loop time ``now_s``; ``cause`` in a few words."""
        self._deaths.append(now_s)
        self._cause = cause

    def reason(self, now_s: float) -> str:
        """What is wrong, in one sentence; empty while it is calm."""
        deaths = self._recent(now_s)
        if deaths < STORM_DEATHS:
            return ""
        return f"{deaths} render workers died within {STORM_WITHIN_S:g} s, the last one: {self._cause}."

    def backoff_s(self, now_s: float) -> float:
        """How long to wait before the next start: nothing while it is calm, then twice as long with every death."""
        excess = self._recent(now_s) - STORM_DEATHS
        return 0.0 if excess < 0 else min(_LONGEST_BACKOFF_S, _SHORTEST_BACKOFF_S * 2.0**excess)

    def _recent(self, now_s: float) -> int:
        while self._deaths and self._deaths[0] < now_s - STORM_WITHIN_S:
            self._deaths.popleft()
        return len(self._deaths)
