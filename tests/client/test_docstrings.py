"""The examples in the docstrings."""

from __future__ import annotations

import asyncio
import doctest
import importlib
import sys

import numpy as np
import pytest
import structlog

import unbend
from tests.client.conftest import Server

MODULES = ["unbend", *(f"unbend.{home}" for home in unbend._HOMES if home != "_errors")]
#: Named constants, which explain themselves.
PLAIN = {"FrameStatus", "Outcome"}


@pytest.mark.parametrize("name", MODULES)
def test_examples_do_what_they_say(server: Server, name: str) -> None:
    # The service logs its calls in this very process, and examples are held to all that is printed.
    structlog.configure(logger_factory=structlog.PrintLoggerFactory(sys.stderr))
    runner = doctest.DocTestRunner(verbose=False)
    module = importlib.import_module(name)
    with unbend.Client(server.target) as client:
        names = {"unbend": unbend, "np": np, "asyncio": asyncio, "client": client}
        for example in doctest.DocTestFinder().find(module, globs=names):
            for step in example.examples:
                step.source = step.source.replace("127.0.0.1:50051", server.target)
            runner.run(example)

    assert runner.tries > 0
    assert runner.failures == 0


def test_every_public_class_shows_how_it_is_used() -> None:
    classes = [getattr(unbend, name) for name in unbend.__all__ if name not in {"Image", *PLAIN}]
    without = [
        kind.__name__
        for kind in classes
        if not issubclass(kind, unbend.UnbendError) and ">>> " not in (kind.__doc__ or "")
    ]
    assert without == []
