"""The examples in the docstrings."""

from __future__ import annotations

import asyncio
import doctest
import importlib

import numpy as np
import pytest

import unbend
from tests.client.conftest import Server


@pytest.mark.parametrize("name", ["unbend", "unbend._client", "unbend._async_client", "unbend._types"])
def test_examples_do_what_they_say(server: Server, name: str) -> None:
    runner = doctest.DocTestRunner(verbose=False)
    with unbend.Client(server.target) as client:
        names = {"unbend": unbend, "np": np, "asyncio": asyncio, "client": client}
        for example in doctest.DocTestFinder().find(importlib.import_module(name), globs=names):
            for step in example.examples:
                step.source = step.source.replace("127.0.0.1:50051", server.target)
            runner.run(example)

    assert runner.tries > 0
    assert runner.failures == 0
