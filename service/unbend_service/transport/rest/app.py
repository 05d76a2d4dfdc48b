"""The HTTP application."""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

from fastapi import Depends, FastAPI
from pydantic.json_schema import models_json_schema

from unbend_service.application.service import Service
from unbend_service.settings import Settings
from unbend_service.transport.rest import cameras, correct, estimate, exchange, grids, health, overlay, pages, problems
from unbend_service.transport.rest.accounting import Accounting
from unbend_service.transport.rest.admitting import Admitting
from unbend_service.transport.rest.bodies import Bodies
from unbend_service.transport.rest.parameters import refuse_unknown

_DESCRIPTION = """Straightens what a lens has bent: a photograph from an unknown camera in, the straight picture out.

Coordinates are centred: x = 2 (i + 0.5) / W - 1 to the right, y = 2 (j + 0.5) / H - 1 down, so [-1, 1] spans the
picture. A grid is a lattice of source points for a regular lattice over the target. Errors are RFC 9457 problems."""


def create_app(service: Service, settings: Settings) -> FastAPI:
    """FastAPI over ``service``, which its caller starts and closes."""
    app = FastAPI(
        title="Unbend",
        version=version("unbend"),
        description=_DESCRIPTION,
        docs_url=None,  # FastAPI's page fetches its scripts from another host; /docs must work offline
        redoc_url=None,
        dependencies=[Depends(refuse_unknown)],
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
        health.router(service),
        pages.router(),
    ):
        app.include_router(router)
    app.add_middleware(Admitting, admission=service.admission, meter=service.meter)
    app.add_middleware(Accounting, meter=service.meter)
    _describe(app)
    return app


def _describe(app: FastAPI) -> None:
    """Adds to OpenAPI the models that routes refer to by name only."""
    generate = app.openapi
    models = (problems.Problem, *grids.COMPONENTS)

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            template = "#/components/schemas/{model}"
            _, definitions = models_json_schema([(model, "validation") for model in models], ref_template=template)
            schema = generate()
            schema.setdefault("components", {}).setdefault("schemas", {}).update(definitions["$defs"])
            app.openapi_schema = schema
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]  # FastAPI documents this way of extending the schema
