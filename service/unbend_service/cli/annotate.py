"""``unbend annotate``."""

from __future__ import annotations

import asyncio
import socket
import webbrowser
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from unbend_service.cli.reporting import console, errors_reported, fail
from unbend_service.cli.serve import read_settings
from unbend_service.logs import configure_logs


def annotate(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Where the photographs lie.")],
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port on 127.0.0.1; 0 takes a free one.")] = 0,
    open_browser: Annotated[bool, typer.Option("--open/--no-open", help="Open the page in the browser.")] = True,
) -> None:
    """Lay curves over what ought to be straight, picture by picture; saved beside each as NAME.unbend.json."""
    import uvicorn  # heavy, as are the transports: only this command needs them here

    from unbend_service.adapters.annotations.folder import AnnotationFolder
    from unbend_service.adapters.metrics.prometheus import PrometheusMeter
    from unbend_service.transport.rest.annotation import create_annotation_app

    configure_logs(read_settings().model_copy(update={"log_level": "warning"}))
    with errors_reported():
        store = AnnotationFolder(folder)
        names = store.names()
        if not names:
            fail(f"{folder} has no photographs: jpg, png, webp or bmp")
        listening = socket.create_server(("127.0.0.1", port))
    address = f"http://127.0.0.1:{listening.getsockname()[1]}/"
    config = uvicorn.Config(
        create_annotation_app(store, PrometheusMeter()),
        ws="none",
        lifespan="off",
        access_log=False,
        log_config=None,
        server_header=False,
    )
    console.print(f"{len(names)} photographs of {folder} at {address} (Ctrl-C ends it)", soft_wrap=True)
    if open_browser:
        webbrowser.open(address)
    with suppress(KeyboardInterrupt):
        asyncio.run(uvicorn.Server(config).serve(sockets=[listening]))
