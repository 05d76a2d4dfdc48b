"""A private service inside a command: the same use cases, without the transports."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from unbend_service.application.service import Service
from unbend_service.logs import configure_logs
from unbend_service.settings import Settings
from unbend_service.wiring import build_service


@asynccontextmanager
async def private_service(settings: Settings, *, renders: bool = True) -> AsyncIterator[Service]:
    """Builds the use cases, starts render workers if the command renders, and ends them afterwards."""
    configure_logs(settings.model_copy(update={"log_level": "warning"}))
    service = build_service(settings)
    try:
        if renders:
            await service.start()
        yield service
    finally:
        await service.close(5.0)
