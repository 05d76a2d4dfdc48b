from __future__ import annotations

from collections.abc import Iterator

import httpx
import pytest
import structlog

from unbend_service.domain import errors
from unbend_service.transport.rest import problems

from .conftest import Bench


def tree(root: type[errors.UnbendError] = errors.UnbendError) -> Iterator[type[errors.UnbendError]]:
    yield root
    for child in root.__subclasses__():
        yield from tree(child)


@pytest.mark.parametrize("kind", sorted(set(tree()), key=lambda kind: kind.__name__))
def test_every_error_has_its_own_status(kind: type[errors.UnbendError]) -> None:
    """The table is total: no error falls through to that of a relative, none is left unnamed."""
    assert kind in problems.TABLE
    status, title = problems.status_and_title(kind)
    assert 400 <= status <= 599
    assert title


def test_the_statuses_of_the_design() -> None:
    """The codes that callers were promised."""
    promised = {
        errors.BodyTooLarge: 413,
        errors.UnsupportedMediaType: 415,
        errors.InvalidImage: 422,
        errors.TooManyPixels: 422,
        errors.FoldedGrid: 422,
        errors.GridNotFound: 404,
        errors.GridConflict: 409,
        errors.QueueFull: 429,
        errors.Draining: 503,
        errors.DeadlineExceeded: 504,
    }
    assert {kind: problems.status_and_title(kind)[0] for kind in promised} == promised


@pytest.mark.parametrize("kind", sorted(set(tree()), key=lambda kind: kind.__name__))
async def test_every_error_is_answered_as_a_problem(bench: Bench, jpeg: bytes, kind: type[errors.UnbendError]) -> None:
    """Whatever goes wrong inside, the caller gets problem+json with the code, what is allowed and the setting."""
    bench.pool.failure = kind("It went wrong.", allowed="something else", setting="workers", retry_after_s=2.5)
    response = await bench.client.post("/v1/correct", content=jpeg, headers={"X-Request-Id": "r1"})
    assert response.status_code == problems.status_and_title(kind)[0]
    assert response.headers["content-type"] == "application/problem+json"
    assert response.json() == {
        "type": f"urn:unbend:error:{kind.code}",
        "title": problems.status_and_title(kind)[1],
        "status": response.status_code,
        "detail": "It went wrong.",
        "code": kind.code,
        "allowed": "something else",
        "setting": "workers",
        "request_id": "r1",
    }
    assert response.headers.get("retry-after") == ("3" if response.status_code in (429, 503) else None)
    problems.Problem.model_validate(response.json())


async def test_a_surprise_says_nothing_but_its_request_id(bench: Bench, jpeg: bytes) -> None:
    """No stack trace leaves the process; the log has it, under the request id that the caller got."""
    bench.estimator.failure = ZeroDivisionError("secret inner state")
    with structlog.testing.capture_logs() as logs:
        response = await bench.client.post("/v1/estimate", content=jpeg)
    assert response.status_code == 500
    assert response.json()["code"] == "internal"
    assert response.json()["request_id"] == response.headers["x-request-id"]
    assert "secret" not in response.text
    assert "Traceback" not in response.text
    assert [entry for entry in logs if entry["log_level"] == "error" and entry["exc_info"]]
    bench.estimator.failure = None
    assert (await bench.client.post("/v1/estimate", content=jpeg)).status_code == 200


@pytest.mark.parametrize(
    ("query", "names"),
    [
        ("strength=2", "strength"),
        ("strength=nan", "strength"),
        ("strength=much", "strength"),
        ("quality=0", "quality"),
        ("quality=101", "quality"),
        ("fit=wide", "fit"),
        ("fit=1.5", "fit"),
        ("fit=nan", "fit"),
        ("correct=some", "correct"),
        ("border=mauve", "border"),
        ("border=12345", "border"),
        ("format=gif", "format"),
        ("min_confidence=-0.1", "min_confidence"),
        ("grid_id=", "grid_id"),
        ("stregnth=0.5", "stregnth"),
    ],
)
async def test_a_bad_query_is_named(client: httpx.AsyncClient, jpeg: bytes, query: str, names: str) -> None:
    """A parameter out of range, or misspelt, is answered by its name before any work is done."""
    response = await client.post(f"/v1/correct?{query}", content=jpeg)
    assert response.status_code == 422
    assert response.headers["content-type"] == "application/problem+json"
    assert response.json()["code"] == "invalid_option"
    assert names in response.json()["detail"]


async def test_unknown_routes_and_methods_are_problems(client: httpx.AsyncClient) -> None:
    """The framework's own refusals look like ours."""
    missing = await client.get("/v2/correct")
    assert (missing.status_code, missing.json()["code"]) == (404, "not_found")
    wrong = await client.get("/v1/correct")
    assert (wrong.status_code, wrong.json()["code"]) == (405, "method_not_allowed")
    assert wrong.headers["allow"] == "POST"
    for response in (missing, wrong):
        problems.Problem.model_validate(response.json())


async def test_draining_refuses_new_calls(bench: Bench, jpeg: bytes) -> None:
    """While the service shuts down new work is refused with 503, and probes are still answered."""
    await bench.service.admission.drain(0.0)
    response = await bench.client.post("/v1/correct", content=jpeg)
    assert (response.status_code, response.json()["code"]) == (503, "draining")
    assert int(response.headers["retry-after"]) >= 1
    assert (await bench.client.get("/livez")).status_code == 200
    ready = await bench.client.get("/readyz")
    assert ready.status_code == 503
    assert ready.json()["ready"] is False
    assert ready.json()["reasons"]
