from __future__ import annotations

from typing import Any

import httpx
import pytest

from unbend_service.domain.frames import BORDER_PATTERN

from .conftest import Bench


@pytest.fixture
async def document(client: httpx.AsyncClient) -> dict[str, Any]:
    found: dict[str, Any] = (await client.get("/openapi.json")).json()
    return found


def references(node: Any) -> set[str]:
    if isinstance(node, dict):
        own = {node["$ref"]} if "$ref" in node else set()
        return own.union(*(references(child) for child in node.values()))
    return set().union(*(references(child) for child in node)) if isinstance(node, list) else set()


async def test_the_calls_of_the_design_are_there(document: dict[str, Any]) -> None:
    """No call is missing and none is made up."""
    calls = {f"{method.upper()} {path}" for path, methods in document["paths"].items() for method in methods}
    assert calls == {
        "POST /v1/correct",
        "POST /v1/estimate",
        "POST /v1/overlay",
        "POST /v1/grids",
        "POST /v1/grids/import",
        "GET /v1/grids/{grid_id}",
        "PUT /v1/grids/{grid_id}",
        "DELETE /v1/grids/{grid_id}",
        "GET /v1/grids/{grid_id}/export",
        "GET /v1/cameras/{name}",
        "DELETE /v1/cameras/{name}",
        "GET /livez",
        "GET /readyz",
        "GET /metrics",
    }


async def test_every_reference_leads_somewhere(document: dict[str, Any]) -> None:
    """Generators can follow every schema."""
    schemas = document["components"]["schemas"]
    for reference in references(document):
        assert reference.removeprefix("#/components/schemas/") in schemas, reference


async def test_errors_are_problems_everywhere(document: dict[str, Any]) -> None:
    """Each error status of the API is described as problem+json; FastAPI's own error schema is nowhere."""
    for path, methods in document["paths"].items():
        for call in methods.values():
            for status, answer in call["responses"].items():
                if path.startswith("/v1/") and int(status) >= 400:
                    assert list(answer["content"]) == ["application/problem+json"], (path, status)
                    assert answer["content"]["application/problem+json"]["schema"] == {
                        "$ref": "#/components/schemas/Problem"
                    }
            if path.startswith("/v1/"):
                assert "500" in call["responses"]
    assert "HTTPValidationError" not in document["components"]["schemas"]


async def test_pictures_may_answer_every_status_of_the_design(document: dict[str, Any]) -> None:
    """The limits of the design are in the description of the calls that take pictures."""
    for path in ("/v1/correct", "/v1/estimate", "/v1/overlay"):
        call = document["paths"][path]["post"]
        assert {"200", "413", "415", "422", "429", "503"} <= set(call["responses"])
        assert "image/jpeg" in call["requestBody"]["content"]
        assert "multipart/form-data" in call["requestBody"]["content"]
    assert {"404", "504"} <= set(document["paths"]["/v1/correct"]["post"]["responses"])


async def test_every_parameter_says_its_range(document: dict[str, Any]) -> None:
    """A number has bounds, a choice its list, and everything a description."""
    for path, methods in document["paths"].items():
        for call in methods.values():
            for parameter in call.get("parameters", []):
                assert parameter.get("description"), (path, parameter["name"])
                for schema in options(parameter["schema"], document):
                    if schema["type"] in ("number", "integer"):
                        assert {"minimum", "maximum"} <= set(schema), (path, parameter)
                    elif schema["type"] == "string":
                        assert "enum" in schema or "maxLength" in schema, (path, parameter)


def options(schema: dict[str, Any], document: dict[str, Any]) -> list[dict[str, Any]]:
    if "$ref" in schema:
        return options(document["components"]["schemas"][schema["$ref"].split("/")[-1]], document)
    if "anyOf" in schema:
        return [found for each in schema["anyOf"] for found in options(each, document)]
    return [] if schema.get("type") == "null" else [schema]


async def test_the_defaults_are_those_of_the_design(document: dict[str, Any]) -> None:
    """Pictures are cropped; estimates are not rescaled."""

    def default(path: str, name: str) -> Any:
        parameters = document["paths"][path]["post"]["parameters"]
        return next(p for p in parameters if p["name"] == name)["schema"].get("default")

    assert default("/v1/correct", "fit") == "crop"
    assert default("/v1/estimate", "fit") == "keep"
    assert default("/v1/correct", "correct") == default("/v1/estimate", "correct") == "nonlinear"


async def test_two_applications_do_not_share_a_document(bench: Bench) -> None:
    """The document is built once per application, and asked for again it is the same."""
    first = (await bench.client.get("/openapi.json")).json()
    assert (await bench.client.get("/openapi.json")).json() == first


async def test_a_border_is_described_by_a_pattern(document: dict[str, Any]) -> None:
    """A generator of clients knows what a border may be."""
    parameters = document["paths"]["/v1/correct"]["post"]["parameters"]
    (border,) = (parameter["schema"] for parameter in parameters if parameter["name"] == "border")
    assert border["pattern"] == BORDER_PATTERN
