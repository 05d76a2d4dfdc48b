"""The service keeps to its OpenAPI document, whatever schemathesis makes of it."""

from __future__ import annotations

import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis.errors import Unsatisfiable
from schemathesis.checks import not_a_server_error
from schemathesis.core.failures import Failure, FailureGroup
from schemathesis.core.result import Ok
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from .conftest import Server

#: Not whether all that the document allows is accepted: no schema says which bytes are a picture, which grid is folded.
_CHECKS = [
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
]
#: Failures are collected and not made smaller: minutes are saved, and a request that failed is short enough to read.
_SEARCH = settings(
    max_examples=5,
    deadline=None,
    database=None,
    derandomize=True,
    phases=(Phase.explicit, Phase.generate),
    suppress_health_check=list(HealthCheck),
)


def test_requests_that_the_document_allows_or_forbids_are_answered_as_it_says(server: Server) -> None:
    """Never a 5xx, and no status, media type, header or body that is not described."""
    document = schemathesis.openapi.from_url(f"http://{server.http}/openapi.json")
    failures: list[str] = []
    tried: set[str] = set()

    for found in document.get_all_operations():
        assert isinstance(found, Ok), found
        operation = found.ok()
        for mode in schemathesis.GenerationMode:

            @_SEARCH
            @given(case=operation.as_strategy(generation_mode=mode))
            def ask(case: schemathesis.Case) -> None:
                tried.add(case.operation.label)
                try:
                    case.call_and_validate(checks=_CHECKS, timeout=60)
                except (Failure, FailureGroup) as error:
                    failures.append(f"{case.operation.label}: {error}")

            try:
                ask()
            except Unsatisfiable:  # nothing can be wrong with a call that takes nothing
                assert mode is schemathesis.GenerationMode.NEGATIVE
    assert not failures, "\n\n".join(failures)
    assert len(tried) == 14
