"""When a call is sent again, and after what pause; no clock and no sleep of its own beyond the one it is given."""

from __future__ import annotations

import random
import time
from collections.abc import Callable

from unbend._errors import DeadlineExceeded, Overloaded, Unavailable, UnbendError

_FIRST_PAUSE_S = 0.1
_LONGEST_PAUSE_S = 2.0


def backoff_s(failures: int) -> float:
    """Pause after the ``failures``-th failure in a row: doubling from 0.1 s to 2 s, a quarter of it by chance."""
    pause_s = min(_FIRST_PAUSE_S * 2.0 ** (failures - 1), _LONGEST_PAUSE_S)
    return pause_s * random.uniform(0.75, 1.0)


class Attempts:
    """The attempts of one call.

    A call is repeated when the server cannot work now or is at a limit, and repeating does no harm. The time allowed
    for the call is for all attempts together.

    Args:
        timeout_s: seconds from now.
        retries: attempts after the first.
        repeatable: whether sending the call twice does no more than sending it once.
    """

    def __init__(
        self, timeout_s: float, retries: int, repeatable: bool, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._clock = clock
        self._end = clock() + timeout_s
        self._retries = retries if repeatable else 0
        self._failures = 0

    @property
    def left_s(self) -> float:
        """Seconds that the next attempt may take."""
        return max(0.001, self._end - self._clock())

    def pause_s(self, error: UnbendError) -> float:
        """Seconds to wait before the next attempt. Raises ``error`` if there is none."""
        self._failures += 1
        if self._failures > self._retries or not isinstance(error, Unavailable | Overloaded):
            raise error
        pause_s = max(backoff_s(self._failures), error.retry_after_s or 0.0)
        if pause_s >= self.left_s:
            raise DeadlineExceeded(f"The time for the call was over after: {error.message}") from error
        return pause_s
