from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import grpc
import pytest

from tests.acceptance.conftest import Server, start_server, stop_server
from tests.acceptance.test_http import facade
from tests.access.scan import Tokens
from unbend_service.domain.access import Grant, Scope, digest_of, line_of, new_token


@dataclass
class Guarded:
    """A real service that asks for tokens, and its file of them."""

    server: Server
    tokens: Tokens
    file: Path

    @property
    def correct(self) -> str:
        return self.tokens.only[Scope.CORRECT]

    def add(self, name: str, *scopes: Scope, rate: float | None = None, streams: int | None = None) -> str:
        """A new token, appended to the file; a new name has limits of its own."""
        token = new_token()
        line = line_of(Grant(name, frozenset(scopes), digest_of(token), rate, 2 if rate else None, streams))
        self.file.write_text(f"{self.file.read_text()}{line}\n")
        return token

    def take_back(self, token: str) -> None:
        lines = self.file.read_text().splitlines()
        digest = digest_of(token).hex()
        self.file.write_text("".join(f"{line}\n" for line in lines if digest not in line))


@pytest.fixture(scope="session")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guarded]:
    file = tmp_path_factory.mktemp("access") / "tokens"
    tokens = Tokens()
    tokens.write(file)
    running = start_server(workers="1", renderer="cpu", tokens_file=str(file), log_level="debug", ops_port="0")
    yield Guarded(running, tokens, file)
    assert stop_server(running) == 0


@pytest.fixture
def channel(guarded: Guarded) -> Iterator[grpc.Channel]:
    with grpc.insecure_channel(guarded.server.grpc) as opened:
        yield opened


@pytest.fixture(scope="session")
def jpeg() -> bytes:
    return bytes(cv2.imencode(".jpg", facade(320, 240))[1].tobytes())
