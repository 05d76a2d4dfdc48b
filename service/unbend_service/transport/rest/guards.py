"""What each route asks of its caller. A route that does not say is a mistake, found when the application is made."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from fastapi import Depends, FastAPI, Request
from fastapi.params import Depends as Dependency
from fastapi.routing import APIRoute, RouteContext, iter_route_contexts
from starlette.datastructures import Headers

from unbend_service.application.access import Access
from unbend_service.domain.access import Scope
from unbend_service.transport.rest.parameters import refuse_unknown

_SCHEME = "bearer "


class Guard:
    """Lets in whoever has a token of ``scope``; everybody if it is None.

    It runs before the parameters are checked and the body is read. The name of the token is left in the state of the
    request, for the log.
    """

    def __init__(self, access: Access | None, scope: Scope | None) -> None:
        self._access = access
        self.scope = scope

    async def __call__(self, request: Request) -> None:
        if self.scope is not None and self._access is not None:
            permit = self._access.admit(bearer(request.headers), self.scope)
            request.state.caller = permit.caller.name


def guarded(access: Access, scope: Scope) -> Sequence[Dependency]:
    """The dependencies of a router whose routes need a token of ``scope``."""
    return [Depends(Guard(access, scope)), Depends(refuse_unknown)]


def public() -> Sequence[Dependency]:
    """The dependencies of a router that is open to everybody."""
    return [Depends(Guard(None, None)), Depends(refuse_unknown)]


def bearer(headers: Headers) -> str | None:
    """The token of the Authorization header."""
    sent = headers.get("authorization", "")
    return sent[len(_SCHEME) :].strip() if sent.lower().startswith(_SCHEME) else None


def guards(app: FastAPI) -> Iterator[tuple[RouteContext, Guard]]:
    """Every route and its guard.

    Raises:
        RuntimeError: a route has none, or more than one, or is of a kind that cannot have one.
    """
    for route in iter_route_contexts(app.routes):
        ours = isinstance(route.original_route, APIRoute)
        found = [each.dependency for each in route.dependencies if isinstance(each.dependency, Guard)] if ours else []
        if len(found) != 1:
            raise RuntimeError(
                f"the route {route.path} does not say whom it is for: guarded(access, scope) or public()"
            )
        yield route, found[0]


def check(app: FastAPI) -> None:
    """Raises RuntimeError, as :func:`guards`."""
    for _ in guards(app):
        pass


def describe(app: FastAPI, access: Access, schema: dict[str, Any]) -> None:
    """Says in an OpenAPI document which scope each call needs, if callers need one."""
    if not access.required:
        return
    scheme = {"type": "http", "scheme": "bearer", "description": "A token of `unbend token new`."}
    schema.setdefault("components", {})["securitySchemes"] = {"token": scheme}
    for route, guard in guards(app):
        for method in route.methods or ():
            call = schema["paths"].get(route.path_format, {}).get(method.lower())
            if call is not None and guard.scope is not None:
                call["security"] = [{"token": [guard.scope.value]}]
