from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

# Most of these tests need the training dependency group, which the service's own environment does not have.
_TRAINS = bool(find_spec("torch") and find_spec("onnx"))
_NUMPY_ALONE = {"test_annotations.py", "test_vistas.py"}
collect_ignore = (
    [] if _TRAINS else [f.name for f in Path(__file__).parent.glob("test_*.py") if f.name not in _NUMPY_ALONE]
)


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Two threads on tiny tensors wait for each other most of the time."""
    if not _TRAINS:
        yield
        return
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
