"""``unbend serve``."""

from __future__ import annotations

from typing import Annotated, Any

import typer
import uvloop
from pydantic import ValidationError

from unbend_service.cli.reporting import errors_reported, fail
from unbend_service.logs import configure_logs
from unbend_service.settings import Settings


def serve(
    host: Annotated[str | None, typer.Option(help="Address of both transports [default: 127.0.0.1].")] = None,
    http_port: Annotated[int | None, typer.Option(help="Port of HTTP [default: 8080].")] = None,
    grpc_port: Annotated[int | None, typer.Option(help="Port of gRPC [default: 50051].")] = None,
    renderer: Annotated[str | None, typer.Option(help="auto, egl or cpu [default: auto].")] = None,
    model: Annotated[str | None, typer.Option(help="Name of a shipped model, or a path.")] = None,
    workers: Annotated[int | None, typer.Option(help="Render workers; 0: one a core [default: 0].")] = None,
    role: Annotated[str | None, typer.Option(help="all, estimate or render [default: all].")] = None,
    estimator: Annotated[str | None, typer.Option(help="With --role render: host:port of who estimates.")] = None,
) -> None:
    """Serve HTTP and gRPC until SIGTERM. Every setting is also a variable UNBEND_...; see docs/configuration.md."""
    chosen: dict[str, Any] = {
        "http_host": host,
        "grpc_host": host,
        "http_port": http_port,
        "grpc_port": grpc_port,
        "renderer": renderer,
        "model": model,
        "workers": workers,
        "role": role,
        "estimator_address": estimator,
    }
    settings = read_settings(**{name: value for name, value in chosen.items() if value is not None})
    configure_logs(settings)
    from unbend_service.serving import serve as serve_until_stopped  # heavy: only this command needs the transports

    with errors_reported():
        uvloop.run(serve_until_stopped(settings))


def read_settings(**chosen: Any) -> Settings:
    """Settings from the environment and the command line; ends the command with a sentence if one is wrong."""
    try:
        return Settings(**chosen)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        fail(f"setting {name} (UNBEND_{name.upper()}): {first['msg']}, not {first['input']!r}", 2)
