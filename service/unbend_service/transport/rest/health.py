"""/livez, /readyz and /metrics."""

from __future__ import annotations

from typing import Any

import orjson
from fastapi import APIRouter, Response
from pydantic import BaseModel

from unbend_service.application.service import Readiness, Service
from unbend_service.domain.access import Scope
from unbend_service.transport.rest import problems
from unbend_service.transport.rest.guards import guarded, public


class RendererBody(BaseModel):
    """Which renderer the workers run."""

    name: str
    device: str
    hardware: bool


class ModelBody(BaseModel):
    """Which network estimates."""

    name: str
    sha256: str


class WorkerBody(BaseModel):
    """One render worker."""

    name: str
    state: str
    restarts: int


class ReadinessBody(BaseModel):
    """Whether calls sent now would be answered, and by what."""

    ready: bool
    reasons: list[str]
    renderer: RendererBody | None
    model: ModelBody
    workers: list[WorkerBody]
    queued: int
    streams: int
    active: int
    role: str


def describe(readiness: Readiness) -> dict[str, Any]:
    """The JSON of /readyz, in the shape of :class:`ReadinessBody`."""
    renderer = readiness.pool.renderer
    workers = [{"name": w.name, "state": w.state, "restarts": w.restarts} for w in readiness.pool.workers]
    return {
        "ready": readiness.ready,
        "reasons": readiness.reasons,
        "renderer": renderer and {"name": renderer.name, "device": renderer.device, "hardware": renderer.hardware},
        "model": {"name": readiness.model.name, "sha256": readiness.model.sha256},
        "workers": workers,
        "queued": readiness.pool.queued,
        "streams": readiness.streams,
        "active": readiness.active,
        "role": readiness.role,
    }


def probes(service: Service) -> APIRouter:
    """/livez and /readyz, open to everybody: a probe has no token."""
    routes = APIRouter(dependencies=public())

    @routes.get(
        "/livez",
        summary="Whether the process answers",
        response_class=Response,
        responses={200: {"content": {"application/json": {"schema": {"type": "object"}}}}},
    )
    async def livez() -> Response:
        """Says nothing about readiness; a process that fails here wants to be restarted."""
        return Response(b'{"live":true}', media_type="application/json")

    @routes.get(
        "/readyz",
        summary="Whether calls sent now would be answered",
        response_class=Response,
        responses={
            200: {"model": ReadinessBody, "description": "Ready."},
            503: {"model": ReadinessBody, "description": "Not ready; `reasons` say why."},
        },
    )
    async def readyz() -> Response:
        """Names the renderer, its device and the model."""
        readiness = service.readiness()
        status = 200 if readiness.ready else 503
        return Response(orjson.dumps(describe(readiness)), status, media_type="application/json")

    return routes


def metrics(service: Service) -> APIRouter:
    """/metrics."""
    routes = APIRouter(dependencies=guarded(service.access, Scope.METRICS))

    @routes.get(
        "/metrics",
        summary="Counts and durations for Prometheus",
        response_class=Response,
        responses={
            200: {"description": "Text format.", "content": {"text/plain": {"schema": {"type": "string"}}}},
            **problems.responses(),
        },
    )
    async def scrape() -> Response:
        """Seconds and bytes."""
        service.meter.pool(service.pool.state())
        service.meter.model(service.model)
        body, content_type = service.meter.render()
        return Response(body, media_type=content_type)

    return routes
