"""The HTTP application."""

from __future__ import annotations

import re
from importlib.metadata import version
from typing import Any

import orjson
from fastapi import APIRouter, FastAPI, Response
from pydantic.json_schema import models_json_schema
from starlette.middleware.cors import CORSMiddleware

from unbend_service.application.service import Service
from unbend_service.domain.access import Scope
from unbend_service.domain.errors import InvalidOption
from unbend_service.settings import Settings
from unbend_service.transport.rest import cameras, correct, estimate, exchange, grids, health, overlay, pages, problems
from unbend_service.transport.rest.accounting import REQUEST_ID_HEADER, Accounting
from unbend_service.transport.rest.admitting import Admitting
from unbend_service.transport.rest.bodies import Bodies
from unbend_service.transport.rest.guards import check, describe, guarded
from unbend_service.transport.rest.provenance import HEADERS

_DESCRIPTION = """Straightens what a lens has bent: a photograph from an unknown camera in, the straight picture out.

Coordinates are centred: x = 2 (i + 0.5) / W - 1 to the right, y = 2 (j + 0.5) / H - 1 down, so [-1, 1] spans the
picture. A grid is a lattice of source points for a regular lattice over the target. Errors are RFC 9457 problems."""

_ORIGIN = re.compile(r"https?://(?:[A-Za-z0-9.-]+|\[[0-9A-Fa-f:]+\])(?::\d{1,5})?")


def create_app(service: Service, settings: Settings) -> FastAPI:
    """FastAPI over ``service``, which its caller starts and closes."""
    app = FastAPI(
        title="Unbend",
        version=version("unbend"),
        description=_DESCRIPTION,
        docs_url=None,  # FastAPI's page fetches its scripts from another host; /docs must work offline
        redoc_url=None,
        openapi_url=None,  # served below, to those who may call
    )
    problems.install(app)
    bodies = Bodies(settings, service.bodies)
    for router in (
        correct.router(service, bodies),
        estimate.router(service, bodies),
        overlay.router(service, bodies),
        grids.router(service, bodies),
        cameras.router(service),
        exchange.router(service, bodies),
        pages.router(),
    ):
        app.include_router(router)
    if settings.ops_port is None:
        _add_health(app, service)
    _describe(app, service)
    check(app)
    app.add_middleware(Admitting, admission=service.admission, meter=service.meter)
    if origins := allowed_origins(settings):
        app.add_middleware(
            CORSMiddleware,
            allow_origins=origins,
            allow_methods=["GET", "POST", "PUT", "DELETE"],
            allow_headers=["Authorization", "Content-Type", REQUEST_ID_HEADER, "traceparent"],
            expose_headers=[*HEADERS, REQUEST_ID_HEADER, "Content-Disposition", "Location", "Retry-After"],
        )
    app.add_middleware(Accounting, meter=service.meter, tracer=service.tracer)
    return app


def create_ops_app(service: Service) -> FastAPI:
    """Health and metrics alone, for a listener of their own."""
    app = FastAPI(title="Unbend health and metrics", docs_url=None, redoc_url=None, openapi_url=None)
    problems.install(app)
    _add_health(app, service)
    check(app)
    app.add_middleware(Accounting, meter=service.meter)
    return app


def allowed_origins(settings: Settings) -> list[str]:
    """The origins of the setting ``cors_origins``.

    Raises:
        InvalidOption: one of them is none, or is ``*``.
    """
    origins = [origin.strip() for origin in settings.cors_origins.split(",") if origin.strip()]
    for origin in origins:
        if not _ORIGIN.fullmatch(origin):
            raise InvalidOption(
                f"{origin!r} is no origin.",
                allowed="https://name or https://name:port, and no *",
                setting="cors_origins",
            )
    return origins


def _add_health(app: FastAPI, service: Service) -> None:
    app.include_router(health.probes(service))
    app.include_router(health.metrics(service))


def _describe(app: FastAPI, service: Service) -> None:
    """Serves OpenAPI, with the models that routes refer to by name only, and with the scopes."""
    routes = APIRouter(include_in_schema=False, dependencies=guarded(service.access, Scope.CORRECT))

    @routes.get("/openapi.json")
    async def document() -> Response:
        return Response(orjson.dumps(app.openapi()), media_type="application/json")

    app.include_router(routes)
    generate = app.openapi
    models = (problems.Problem, *grids.COMPONENTS)

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            template = "#/components/schemas/{model}"
            _, definitions = models_json_schema([(model, "validation") for model in models], ref_template=template)
            schema = generate()
            schema.setdefault("components", {}).setdefault("schemas", {}).update(definitions["$defs"])
            describe(app, service.access, schema)
            app.openapi_schema = schema
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]  # FastAPI documents this way of extending the schema
