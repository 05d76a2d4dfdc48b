"""Servers that tests need beside the service: real ones."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TypeVar

import pytest

from benchmarks.companions import MissingProgram

T = TypeVar("T")


def started(start: Callable[[], T]) -> T:
    """What ``start`` starts; the test is skipped where it is not installed, unless UNBEND_REQUIRE_SERVERS=1."""
    try:
        return start()
    except MissingProgram as error:
        if os.environ.get("UNBEND_REQUIRE_SERVERS") == "1":
            raise
        pytest.skip(str(error))
