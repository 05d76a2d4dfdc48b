"""Tries every route and every RPC without a token, with a wrong one, and with one of the wrong scope.

``python -m tests.access.scan`` starts a service, prints what each call was answered, and a verdict.
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import grpc
from google.protobuf import descriptor_pb2
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc

from tests.acceptance.conftest import Server, start_server, stop_server
from tests.assembly import service_over_fakes
from unbend_service.domain.access import Grant, Scope, digest_of, line_of, new_token
from unbend_service.settings import Settings
from unbend_service.transport.rest.app import create_app
from unbend_service.transport.rest.guards import guards
from unbend_service.transport.rpc.scopes import SCOPES

#: What is open to everybody, and nothing else is. Pages and their files hold no data; probes have no token.
PUBLIC_PATHS = frozenset({"/", "/docs", "/livez", "/readyz"})
OPS_PATHS = frozenset({"/livez", "/readyz", "/metrics"})
PUBLIC_FILES = "/web/"
PUBLIC_METHODS = frozenset(f"/grpc.health.v1.Health/{name}" for name in ("Check", "List", "Watch"))
_REFUSED = {401, 403, "UNAUTHENTICATED", "PERMISSION_DENIED"}
_TIMEOUT_S = 10.0

Answer = int | str


@dataclass(frozen=True)
class Tokens:
    """A token of each scope, one of everything but each scope, and one that nobody knows."""

    only: Mapping[Scope, str] = field(default_factory=lambda: {scope: new_token() for scope in Scope})
    other: Mapping[Scope, str] = field(default_factory=lambda: {scope: new_token() for scope in Scope})
    unknown: str = field(default_factory=new_token)

    def write(self, path: Path) -> None:
        """The tokens file of a service that is to be scanned."""
        ordinary = frozenset(Scope) - {Scope.ADMIN}
        grants = [Grant(f"only-{scope}", frozenset({scope}), digest_of(token)) for scope, token in self.only.items()]
        grants += [Grant(f"not-{scope}", ordinary - {scope}, digest_of(token)) for scope, token in self.other.items()]
        path.write_text("".join(f"{line_of(grant)}\n" for grant in grants))

    def all(self) -> Iterator[str]:
        yield from self.only.values()
        yield from self.other.values()
        yield self.unknown


@dataclass(frozen=True)
class Finding:
    """What one call was answered: without a token, with a wrong one, with one of the wrong scope, with the right one.

    Attributes:
        scope: that it needs; None for one that is open to everybody.
    """

    call: str
    scope: Scope | None
    without: Answer
    unknown: Answer
    wrong_scope: Answer
    right: Answer

    @property
    def is_as_promised(self) -> bool:
        if self.scope is None:
            return not {self.without, self.unknown, self.wrong_scope, self.right} & _REFUSED
        denied = 403 if isinstance(self.without, int) else "PERMISSION_DENIED"
        unauthenticated = 401 if isinstance(self.without, int) else "UNAUTHENTICATED"
        refused = (self.without, self.unknown, self.wrong_scope) == (unauthenticated, unauthenticated, denied)
        return refused and self.right not in _REFUSED


def scan_http(server: Server, tokens: Tokens) -> list[Finding]:
    """Every route that the application has; those of the server's own OpenAPI must be among them."""
    routes = list(http_routes())
    document = json.loads(_get(server.http, "/openapi.json", tokens.only[Scope.ADMIN]))
    listed = {(method.upper(), path) for path, calls in document["paths"].items() for method in calls}
    missing = listed - {(method, path) for method, path, _ in routes}
    if missing:
        raise AssertionError(f"not scanned: {missing}")
    findings = []
    for method, path, scope in routes:
        address = server.ops if server.ops and path in OPS_PATHS else server.http
        ask = partial(_status, address, method, re.sub(r"\{[^}]*\}", "g0", path))
        findings.append(_finding(f"{method} {path}", scope, tokens, ask))
    return findings


def http_routes() -> Iterator[tuple[str, str, Scope | None]]:
    """Method, path and scope of every route."""
    settings = Settings()
    service = service_over_fakes(settings)
    try:
        for route, guard in guards(create_app(service, settings)):
            for method in sorted(route.methods or ()):
                yield method, str(route.path_format), guard.scope
    finally:
        service.blocking.close()


def scan_grpc(channel: grpc.Channel, tokens: Tokens) -> list[Finding]:
    """Every method of every service that the server itself tells of."""
    return [
        _finding(method, SCOPES.get(method), tokens, partial(_code, channel, method))
        for method in grpc_methods(channel, tokens.only[Scope.ADMIN])
    ]


def grpc_methods(channel: grpc.Channel, token: str) -> list[str]:
    """Full names, asked by reflection."""
    stub = reflection_pb2_grpc.ServerReflectionStub(channel)

    def ask(request: reflection_pb2.ServerReflectionRequest) -> reflection_pb2.ServerReflectionResponse:
        return next(stub.ServerReflectionInfo(iter([request]), metadata=_metadata(token), timeout=_TIMEOUT_S))

    methods: set[str] = set()
    for service in ask(reflection_pb2.ServerReflectionRequest(list_services="")).list_services_response.service:
        files = ask(reflection_pb2.ServerReflectionRequest(file_containing_symbol=service.name))
        for body in files.file_descriptor_response.file_descriptor_proto:
            file = descriptor_pb2.FileDescriptorProto.FromString(body)
            for each in file.service:
                if f"{file.package}.{each.name}" == service.name:
                    methods |= {f"/{service.name}/{method.name}" for method in each.method}
    return sorted(methods)


def table(findings: list[Finding]) -> str:
    """For people."""
    rows = [("call", "scope", "no token", "unknown", "wrong scope", "right scope", "")]
    for one in findings:
        verdict = "" if one.is_as_promised else "NOT AS PROMISED"
        answers = (str(one.without), str(one.unknown), str(one.wrong_scope), str(one.right))
        rows.append((one.call, str(one.scope or "open"), *answers, verdict))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
    return "\n".join(line.rstrip() for line in lines)


def _finding(call: str, scope: Scope | None, tokens: Tokens, ask: Callable[[str | None], Answer]) -> Finding:
    wanted = scope or Scope.CORRECT
    return Finding(call, scope, ask(None), ask(tokens.unknown), ask(tokens.other[wanted]), ask(tokens.only[wanted]))


def _status(address: str, method: str, path: str, token: str | None) -> int:
    request = urllib.request.Request(f"http://{address}{path}", method=method, headers=_headers(token))
    if method in ("POST", "PUT"):
        request.data = b"nothing that could be taken"
    try:
        with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as answer:
            return int(answer.status)
    except urllib.error.HTTPError as error:
        with error:
            return error.code


def _get(address: str, path: str, token: str) -> bytes:
    request = urllib.request.Request(f"http://{address}{path}", headers=_headers(token))
    with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as answer:
        return bytes(answer.read())


def _headers(token: str | None) -> dict[str, str]:
    return {} if token is None else {"Authorization": f"Bearer {token}"}


def _metadata(token: str | None) -> tuple[tuple[str, str], ...]:
    return () if token is None else (("authorization", f"Bearer {token}"),)


def _code(channel: grpc.Channel, method: str, token: str | None) -> str:
    """How a call with one empty message ends, or how it begins if it goes on."""
    call = channel.stream_stream(method)(iter([b""]), metadata=_metadata(token), timeout=_TIMEOUT_S)
    try:
        next(call, None)
        return "OK"
    except grpc.RpcError as error:
        return str(error.code().name)
    finally:
        call.cancel()


def main() -> int:
    """Scans a service of its own; 0 if everything is as promised."""
    tokens = Tokens()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "tokens")
        tokens.write(file)
        server = start_server(workers="1", renderer="cpu", tokens_file=str(file))
        try:
            with grpc.insecure_channel(server.grpc) as channel:
                findings = scan_http(server, tokens) + scan_grpc(channel, tokens)
        finally:
            stop_server(server)
    wrong = [finding for finding in findings if not finding.is_as_promised]
    guarded = sum(finding.scope is not None for finding in findings)
    print(table([finding for finding in findings if not finding.call.startswith(f"GET {PUBLIC_FILES}")]))
    print(
        f"{'FAILED' if wrong else 'OK'}: {guarded} of {len(findings)} calls need a token; refused as promised: "
        f"{guarded - sum(finding.scope is not None for finding in wrong)}; wrongly answered: {len(wrong)}"
    )
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
