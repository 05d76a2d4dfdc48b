"""/, /docs and their assets: plain files, nothing from another host."""

from __future__ import annotations

from pathlib import Path

from fastapi import APIRouter, Response

WEB_FOLDER = Path(__file__).resolve().parents[2] / "web"

_PAGES = {"/": "index.html", "/docs": "docs.html", "/web/docs.js": "docs.js", "/web/style.css": "style.css"}
_MEDIA_TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css"}
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' data: blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}


def router() -> APIRouter:
    """One route per file; none of them in OpenAPI."""
    routes = APIRouter(include_in_schema=False)
    for path, name in _PAGES.items():
        _add_page(routes, path, WEB_FOLDER / name)
    return routes


def _add_page(routes: APIRouter, path: str, file: Path) -> None:
    content = file.read_bytes()
    media_type = f"{_MEDIA_TYPES[file.suffix]}; charset=utf-8"

    @routes.get(path)
    async def page() -> Response:
        return Response(content, media_type=media_type, headers=_HEADERS)
