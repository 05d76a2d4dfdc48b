"""A node that renders shows the node that estimates who it is."""

from __future__ import annotations

import json
import urllib.request
from pathlib import Path

import pytest

from tests.acceptance.conftest import start_server, stop_server
from tests.access.conftest import Guarded
from unbend_service.adapters.estimators.node_credentials import read_node_credentials
from unbend_service.domain.errors import InvalidOption
from unbend_service.settings import Settings


def test_a_node_that_estimates_is_opened_by_the_token_of_the_node_that_renders(
    guarded: Guarded, jpeg: bytes, tmp_path: Path
) -> None:
    token = tmp_path / "token"
    token.write_text(guarded.correct + "\n")
    renders = start_server(
        role="render",
        workers="1",
        renderer="cpu",
        estimator_address=guarded.server.grpc,
        estimator_token_file=str(token),
    )
    try:
        request = urllib.request.Request(f"http://{renders.http}/v1/estimate", data=jpeg)
        with urllib.request.urlopen(request, timeout=60) as answer:
            assert json.loads(answer.read())["grid_id"]
    finally:
        assert stop_server(renders) == 0


def test_what_cannot_open_the_other_node_is_said_at_the_start(tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.write_text("\n")
    for wrong in (empty, tmp_path / "missing", Path(__file__)):
        with pytest.raises(InvalidOption) as failure:
            read_node_credentials(Settings(estimator_token_file=wrong))
        assert failure.value.setting == "estimator_token_file"
    with pytest.raises(InvalidOption, match=r"missing cannot be read"):
        read_node_credentials(Settings(estimator_ca=tmp_path / "missing"))
    assert read_node_credentials(Settings()) == (None, ())
