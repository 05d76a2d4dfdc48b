"""Nobody gets in where he should not: every route and RPC of a running service."""

from __future__ import annotations

import grpc
import pytest
from fastapi import APIRouter, FastAPI

from tests.access.conftest import Guarded
from tests.access.scan import (
    PUBLIC_FILES,
    PUBLIC_METHODS,
    PUBLIC_PATHS,
    Finding,
    grpc_methods,
    scan_grpc,
    scan_http,
    table,
)
from unbend_service.domain.access import Scope
from unbend_service.transport.rest import guards
from unbend_service.transport.rpc import scopes


@pytest.fixture(scope="session")
def http_findings(guarded: Guarded) -> list[Finding]:
    return scan_http(guarded.server, guarded.tokens)


def test_every_route_refuses_no_token_a_wrong_one_and_one_of_the_wrong_scope(http_findings: list[Finding]) -> None:
    wrong = [finding for finding in http_findings if not finding.is_as_promised]
    assert not wrong, table(wrong)
    assert sum(finding.scope is not None for finding in http_findings) >= 10


def test_nothing_but_pages_and_probes_is_open(http_findings: list[Finding]) -> None:
    """Whoever opens a route to everybody has to say so here too."""
    paths = {finding.call.partition(" ")[2] for finding in http_findings if finding.scope is None}
    assert {path for path in paths if not path.startswith(PUBLIC_FILES)} <= PUBLIC_PATHS


def test_every_rpc_refuses_no_token_a_wrong_one_and_one_of_the_wrong_scope(
    guarded: Guarded, channel: grpc.Channel
) -> None:
    findings = scan_grpc(channel, guarded.tokens)
    wrong = [finding for finding in findings if not finding.is_as_promised]
    assert not wrong, table(wrong)
    assert {finding.call for finding in findings if finding.scope is None} == PUBLIC_METHODS


def test_the_server_has_no_method_without_a_scope(guarded: Guarded, channel: grpc.Channel) -> None:
    assert set(grpc_methods(channel, guarded.tokens.only[Scope.ADMIN])) == set(scopes.SCOPES)


def test_a_route_that_does_not_say_whom_it_is_for_is_found_when_the_application_is_made() -> None:
    app, routes = FastAPI(docs_url=None, redoc_url=None, openapi_url=None), APIRouter(dependencies=guards.public())
    routes.get("/declared")(lambda: None)
    app.include_router(routes)
    guards.check(app)
    app.get("/forgotten")(lambda: None)
    with pytest.raises(RuntimeError, match="/forgotten"):
        guards.check(app)


def test_a_method_that_does_not_say_whom_it_is_for_is_found_when_the_server_is_made() -> None:
    scopes.check(scopes.SCOPES)
    with pytest.raises(RuntimeError, match="Forgotten"):
        scopes.check([*scopes.SCOPES, "/unbend.v1.GridService/Forgotten"])
