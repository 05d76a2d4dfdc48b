from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.acceptance.conftest import start_server
from unbend_service.domain.errors import InvalidOption
from unbend_service.exposure import check_exposure
from unbend_service.settings import Settings


def test_the_defaults_reach_this_machine_only() -> None:
    assert check_exposure(Settings()) == []
    assert check_exposure(Settings(http_host="localhost", grpc_host="::1", ops_port=0)) == []


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "", "*", "0", "::ffff:0.0.0.0"])
@pytest.mark.parametrize("setting", ["http_host", "grpc_host", "ops_host"])
def test_every_address_of_the_machine_is_refused_while_anybody_may_call(host: str, setting: str) -> None:
    settings: dict[str, Any] = {setting: host, "ops_port": 0}
    with pytest.raises(InvalidOption, match="every address") as failure:
        check_exposure(Settings(**settings))
    assert failure.value.setting == setting
    assert check_exposure(Settings(open_access=True, **settings)) == []
    assert check_exposure(Settings(tokens_file=Path("tokens"), **settings)) == []


def test_client_certificates_are_enough_where_they_are_asked_for() -> None:
    """Of probes none is asked, so what they listen to needs tokens."""
    locked: dict[str, Any] = {"tls_client_ca": Path("ca"), "tls_cert": Path("cert"), "tls_key": Path("key")}
    assert check_exposure(Settings(http_host="0.0.0.0", grpc_host="::", **locked)) == []
    with pytest.raises(InvalidOption):
        check_exposure(Settings(ops_host="0.0.0.0", ops_port=0, **locked))


def test_one_address_that_others_reach_is_warned_of() -> None:
    warnings = check_exposure(Settings(http_host="192.0.2.1"))
    assert len(warnings) == 1
    assert "http_host" in warnings[0]


def test_tls_that_is_required_is_required() -> None:
    with pytest.raises(InvalidOption, match="no certificate"):
        check_exposure(Settings(tls_required=True))


def test_the_command_ends_with_a_sentence_and_serves_nobody() -> None:
    with pytest.raises(AssertionError, match="UNBEND_OPEN_ACCESS") as failure:
        start_server(http_host="0.0.0.0")
    assert "Traceback" not in str(failure.value)
