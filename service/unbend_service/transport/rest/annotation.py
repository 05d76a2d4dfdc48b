"""The annotation page and its calls: a service of its own, for one person on the same machine."""

from __future__ import annotations

from pathlib import PurePath
from typing import Any

import orjson
from fastapi import FastAPI, Request, Response
from fastapi.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.middleware.trustedhost import TrustedHostMiddleware

from unbend_service.application.annotation import AnnotationStore
from unbend_service.application.ports import Meter
from unbend_service.domain.annotation import VERSION, Annotation
from unbend_service.domain.errors import InvalidGuides
from unbend_service.transport.rest import pages, problems
from unbend_service.transport.rest.accounting import Accounting
from unbend_service.transport.rest.bodies import read_body

_BODY_BYTES = 1 << 20
_MEDIA_TYPES = {".png": "image/png", ".webp": "image/webp", ".bmp": "image/bmp"}


def create_annotation_app(store: AnnotationStore, meter: Meter) -> FastAPI:
    """FastAPI over the pictures of ``store``.

    It answers to the names of this machine only: a page of another site that points its own name here gets nothing.
    """
    app = FastAPI(title="Unbend annotation", docs_url=None, redoc_url=None, openapi_url=None)
    problems.install(app)
    app.include_router(pages.router({"/": "annotate.html"}))

    @app.get("/annotation")
    async def overview() -> Response:
        """The pictures, and which of them are done."""
        return _json(await run_in_threadpool(_overview, store))

    @app.get("/annotation/pictures/{name}")
    async def picture(name: str) -> Response:
        """The file, as it is."""
        body = await run_in_threadpool(store.picture, name)
        if body is None:
            raise HTTPException(404)
        media_type = _MEDIA_TYPES.get(PurePath(name).suffix.lower(), "image/jpeg")
        return Response(body, media_type=media_type, headers=pages.HEADERS)

    @app.get("/annotation/curves/{name}")
    async def read(name: str) -> Response:
        """What was said so far; null if nothing was."""
        _check_known(store, name)
        annotation = await run_in_threadpool(store.read, name)
        return _json(None if annotation is None else annotation.to_dict())

    @app.put("/annotation/curves/{name}")
    async def write(name: str, request: Request) -> Response:
        """{width, height, rows, columns}; what is kept comes back, coefficients included."""
        _check_known(store, name)
        body = await read_body(request, _BODY_BYTES)
        try:
            value = orjson.loads(body)
        except orjson.JSONDecodeError as error:
            raise InvalidGuides(f"The body is not JSON: {error}.") from error
        if not isinstance(value, dict):
            raise InvalidGuides("An annotation must be an object.")
        annotation = Annotation.from_dict({**value, "version": VERSION, "image": name})
        await run_in_threadpool(store.write, annotation)
        return _json({**annotation.to_dict(), "complete": annotation.is_complete})

    app.add_middleware(TrustedHostMiddleware, allowed_hosts=["127.0.0.1", "localhost"])
    app.add_middleware(Accounting, meter=meter)
    return app


def _overview(store: AnnotationStore) -> dict[str, Any]:
    def is_complete(name: str) -> bool:
        try:
            annotation = store.read(name)
        except InvalidGuides:  # said when the picture is opened
            return False
        return annotation is not None and annotation.is_complete

    return {
        "title": store.title,
        "pictures": [{"name": name, "complete": is_complete(name)} for name in store.names()],
    }


def _check_known(store: AnnotationStore, name: str) -> None:
    if name not in store.names():
        raise HTTPException(404)


def _json(value: Any) -> Response:
    return Response(orjson.dumps(value), media_type="application/json", headers={"Cache-Control": "no-store"})
