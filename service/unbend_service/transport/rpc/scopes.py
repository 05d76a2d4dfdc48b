"""What each RPC asks of its caller. One that does not stand here is a mistake, found when the server is made."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final

import grpc

from unbend_service.domain.access import Scope

#: In the place of a scope: open to everybody.
PUBLIC: Final = None

SCOPES: Mapping[str, Scope | None] = {
    "/unbend.v1.EstimationService/Estimate": Scope.CORRECT,
    "/unbend.v1.EstimationService/EstimateGuides": Scope.CORRECT,
    "/unbend.v1.CorrectionService/Correct": Scope.CORRECT,
    "/unbend.v1.CorrectionService/CorrectStream": Scope.CORRECT,
    "/unbend.v1.GridService/GetGrid": Scope.GRIDS,
    "/unbend.v1.GridService/PutGrid": Scope.GRIDS,
    "/unbend.v1.GridService/DeleteGrid": Scope.GRIDS,
    # probes and load balancers have no token, and learn no more than whether calls would be answered
    "/grpc.health.v1.Health/Check": PUBLIC,
    "/grpc.health.v1.Health/List": PUBLIC,
    "/grpc.health.v1.Health/Watch": PUBLIC,
    "/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo": Scope.ADMIN,
}


def check(methods: Iterable[str]) -> None:
    """Raises RuntimeError if a method of the server has no scope, or a scope no method."""
    found = set(methods)
    if found != set(SCOPES):
        raise RuntimeError(f"these methods do not say whom they are for: {sorted(found ^ set(SCOPES))}")


def token_of(details: grpc.HandlerCallDetails) -> str | None:
    """The bearer token of the metadata ``authorization``."""
    for key, value in details.invocation_metadata or ():
        if key == "authorization" and isinstance(value, str) and value[:7].lower() == "bearer ":
            return value[7:].strip()
    return None
