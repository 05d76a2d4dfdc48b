"""/, /docs and their assets: plain files, nothing from another host.

Every file below ``web/`` has a route of its own, made at start; no path of a request ever reaches the file system.
"""

from __future__ import annotations

from pathlib import Path

from fastapi import APIRouter, Response

from unbend_service.transport.rest.guards import public

WEB_FOLDER = Path(__file__).resolve().parents[2] / "web"

_PAGES = {"/": "index.html", "/docs": "docs.html"}
_MEDIA_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
    ".jpg": "image/jpeg",
    ".png": "image/png",
}
#: What every page and asset is sent with.
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' data: blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=(), payment=(), usb=()",
    "Cache-Control": "no-cache",
}


def router(pages: dict[str, str] | None = None) -> APIRouter:
    """One route per file; none of them in OpenAPI.

    Args:
        pages: addresses of the documents; those of the service if left out.
    """
    routes = APIRouter(include_in_schema=False, dependencies=public())
    for path, name in (_PAGES if pages is None else pages).items():
        _add_page(routes, path, WEB_FOLDER / name)
    for file in sorted(WEB_FOLDER.rglob("*")):
        if file.suffix in _MEDIA_TYPES and file.suffix != ".html":
            _add_page(routes, f"/web/{file.relative_to(WEB_FOLDER).as_posix()}", file)
    return routes


def _add_page(routes: APIRouter, path: str, file: Path) -> None:
    content = file.read_bytes()
    media_type = _MEDIA_TYPES[file.suffix]

    @routes.get(path)
    async def page() -> Response:
        return Response(content, media_type=media_type, headers=HEADERS)
