from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec

import pytest

# These tests need the training dependency group, which the service's own environment does not have.
collect_ignore_glob = [] if find_spec("torch") and find_spec("onnx") else ["test_*.py"]


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Two threads on tiny tensors wait for each other most of the time."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
