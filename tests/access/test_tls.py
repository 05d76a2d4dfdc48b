"""TLS and client certificates of a running service, on both transports."""

from __future__ import annotations

import json
import os
import socket
import ssl
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import grpc
import pytest
import trustme
from typer.testing import CliRunner

import unbend
from tests.acceptance.conftest import Server, start_server, stop_server
from unbend_service.cli import app
from unbend_service.domain.errors import InvalidOption
from unbend_service.domain.grid import Grid
from unbend_service.domain.records import GridRecord
from unbend_service.settings import Settings
from unbend_service.transport.tls import Certificates, read_certificates


def replace(path: Path, content: bytes) -> None:
    """As a careful operator does it: whole or not at all."""
    fresh = path.with_suffix(".fresh")
    fresh.write_bytes(content)
    os.replace(fresh, path)


@dataclass
class Party:
    """One side: an authority, and a certificate of it with its key, as files."""

    authority: trustme.CA
    folder: Path

    def __post_init__(self) -> None:
        self.folder.mkdir()
        self.ca, self.cert, self.key = (self.folder / name for name in ("ca.pem", "cert.pem", "key.pem"))
        self.authority.cert_pem.write_to_path(str(self.ca))
        self.issue()

    def issue(self) -> None:
        leaf = self.authority.issue_cert("localhost", "127.0.0.1")
        replace(self.key, leaf.private_key_pem.bytes())
        replace(self.cert, leaf.cert_chain_pems[0].bytes())


@dataclass
class Locked:
    """A service that speaks TLS to clients with a certificate only."""

    server: Server
    here: Party
    client: Party
    stranger: Party

    def context(self, party: Party | None) -> ssl.SSLContext:
        context = ssl.create_default_context(cafile=str(self.here.ca))
        if party is not None:
            context.load_cert_chain(party.cert, party.key)
        return context

    def get(self, address: str, path: str, party: Party | None) -> int:
        with urllib.request.urlopen(f"https://{address}{path}", timeout=10, context=self.context(party)) as answer:
            return int(answer.status)

    def serial(self) -> int:
        """Of the certificate that a new connection is shown."""
        host, _, port = self.server.http.rpartition(":")
        with (
            socket.create_connection((host, int(port)), timeout=10) as plain,
            self.context(self.client).wrap_socket(plain, server_hostname="localhost") as wrapped,
        ):
            return int(str((wrapped.getpeercert() or {})["serialNumber"]), 16)


@pytest.fixture(scope="module")
def locked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Locked]:
    folder = tmp_path_factory.mktemp("tls")
    here, client, stranger = (Party(trustme.CA(), folder / name) for name in ("here", "client", "stranger"))
    server = start_server(
        workers="1",
        renderer="cpu",
        tls_cert=str(here.cert),
        tls_key=str(here.key),
        tls_client_ca=str(client.ca),
        tls_required="true",
        ops_port="0",
        handshake_s="3",
    )
    yield Locked(server, here, client, stranger)
    assert stop_server(server) == 0


def test_plain_text_is_refused_by_every_listener(locked: Locked) -> None:
    for address in (locked.server.http, locked.server.ops):
        with pytest.raises((urllib.error.URLError, ConnectionError)):
            urllib.request.urlopen(f"http://{address}/livez", timeout=10)
    client = unbend.Client(locked.server.grpc, timeout_s=3, retries=0)
    with client, pytest.raises((unbend.Unreachable, unbend.DeadlineExceeded)):
        client.estimate(b"nothing")


def test_a_command_speaks_tls_and_shows_its_certificate(locked: Locked, tmp_path: Path) -> None:
    """With the authorities of the server and a certificate of its own it is let in."""
    record, file = GridRecord(Grid.identity()), tmp_path / "grid.json"
    file.write_text(json.dumps(record.to_dict()))
    reached = ["grid", "import", str(file), "--server", locked.server.grpc, "--ca", str(locked.here.ca)]
    shown = ["--cert", str(locked.client.cert), "--key", str(locked.client.key)]
    done = CliRunner().invoke(app, [*reached, *shown])
    assert done.exit_code == 0, done.output
    assert record.id in done.output
    half = CliRunner().invoke(app, [*reached, *shown[:2]])
    assert half.exit_code == 3
    assert "go together" in half.output


def test_a_client_without_a_certificate_or_with_a_strangers_is_refused(locked: Locked) -> None:
    for party in (None, locked.stranger):
        with pytest.raises((urllib.error.URLError, ConnectionError, ssl.SSLError)):
            locked.get(locked.server.http, "/livez", party)
        files = {} if party is None else {"cert_file": party.cert, "key_file": party.key}
        client = unbend.Client(locked.server.grpc, timeout_s=3, retries=0, ca_file=locked.here.ca, **files)
        with client, pytest.raises((unbend.Unreachable, unbend.DeadlineExceeded)):
            client.estimate(b"nothing")


def test_a_client_who_connects_and_says_nothing_is_dropped_by_every_listener(locked: Locked) -> None:
    """It keeps a descriptor for as long as a handshake may take, and no longer."""
    silent = [
        socket.create_connection((address.rpartition(":")[0], int(address.rpartition(":")[2])), timeout=20)
        for address in (locked.server.http, locked.server.ops, locked.server.grpc)
    ]
    for connection in silent:
        with connection, suppress(ConnectionError):
            while connection.recv(4096):  # gRPC sends its settings first
                pass


def test_browsers_are_told_to_come_over_tls_only(locked: Locked) -> None:
    address = f"https://{locked.server.http}/"
    with urllib.request.urlopen(address, timeout=10, context=locked.context(locked.client)) as answer:
        assert answer.headers["Strict-Transport-Security"] == "max-age=31536000"


def test_a_client_with_a_certificate_is_served(locked: Locked) -> None:
    assert locked.get(locked.server.http, "/openapi.json", locked.client) == 200
    client = unbend.Client(
        locked.server.grpc, ca_file=locked.here.ca, cert_file=locked.client.cert, key_file=locked.client.key
    )
    with client, pytest.raises(unbend.UnsupportedMediaType):
        client.estimate(b"this is no picture")


def test_probes_need_no_certificate_but_trust(locked: Locked) -> None:
    assert locked.get(locked.server.ops, "/readyz", None) == 200
    with pytest.raises(urllib.error.URLError, match="CERTIFICATE_VERIFY_FAILED"):
        urllib.request.urlopen(f"https://{locked.server.ops}/readyz", timeout=10)


def test_certificates_are_exchanged_while_connections_go_on(locked: Locked) -> None:
    """New connections see the new certificate, on both transports; a client that is connected notices nothing."""
    before = locked.serial()
    client = unbend.Client(
        locked.server.grpc, ca_file=locked.here.ca, cert_file=locked.client.cert, key_file=locked.client.key
    )
    with client:
        with pytest.raises(unbend.UnsupportedMediaType):
            client.estimate(b"this is no picture")
        locked.here.issue()
        end = time.monotonic() + 5
        while locked.serial() == before and time.monotonic() < end:
            time.sleep(0.1)
        assert locked.serial() != before
        with pytest.raises(unbend.UnsupportedMediaType):
            client.estimate(b"this is no picture")
    host, _, port = locked.server.grpc.rpartition(":")
    shown = ssl.get_server_certificate((host, int(port)), timeout=10)
    assert shown.split() == locked.here.cert.read_text().split()


def test_authorities_of_clients_are_exchanged_too(locked: Locked) -> None:
    """Whoever is certified by an authority that was taken away is a stranger from then on."""
    trusted = locked.client.ca.read_bytes()
    replace(locked.client.ca, locked.stranger.ca.read_bytes())
    try:
        assert _served(locked, locked.stranger)
        with pytest.raises((urllib.error.URLError, ConnectionError, ssl.SSLError)):
            locked.get(locked.server.http, "/openapi.json", locked.client)
        files = {"cert_file": locked.client.cert, "key_file": locked.client.key}
        client = unbend.Client(locked.server.grpc, timeout_s=3, retries=0, ca_file=locked.here.ca, **files)
        with client, pytest.raises((unbend.Unreachable, unbend.DeadlineExceeded)):
            client.estimate(b"nothing")
    finally:
        replace(locked.client.ca, trusted)
    assert _served(locked, locked.client)


def _served(locked: Locked, party: Party) -> bool:
    end = time.monotonic() + 5
    while time.monotonic() < end:
        try:
            return locked.get(locked.server.http, "/openapi.json", party) == 200
        except (urllib.error.URLError, ConnectionError, ssl.SSLError):
            time.sleep(0.1)
    return False


@pytest.fixture
def party(tmp_path: Path) -> Party:
    return Party(trustme.CA(), tmp_path / "here")


def test_a_broken_exchange_leaves_what_was_there_before(party: Party) -> None:
    """It is told once; the next good one is taken."""
    certificates = Certificates(party.cert, party.key, None)
    assert not certificates.refresh()
    replace(party.cert, b"nonsense")
    with pytest.raises(InvalidOption, match="cannot be used"):
        certificates.refresh()
    assert not certificates.refresh()
    party.issue()
    assert certificates.refresh()


def test_what_cannot_be_a_certificate_is_said_at_the_start(party: Party, tmp_path: Path) -> None:
    other = Party(trustme.CA(), tmp_path / "other")
    with pytest.raises(InvalidOption, match="go together"):
        read_certificates(Settings(tls_cert=party.cert))
    with pytest.raises(InvalidOption, match="go together"):
        read_certificates(Settings(tls_client_ca=party.ca))
    with pytest.raises(InvalidOption, match="cannot be used"):
        read_certificates(Settings(tls_cert=party.cert, tls_key=other.key))
    with pytest.raises(InvalidOption, match=r"missing\.pem cannot be read"):
        read_certificates(Settings(tls_cert=tmp_path / "missing.pem", tls_key=party.key))
    assert read_certificates(Settings()) is None


def test_a_client_says_which_file_it_cannot_read(party: Party) -> None:
    with pytest.raises(unbend.InvalidOption, match=r"missing\.pem"):
        unbend.Client(ca_file="missing.pem")
    with pytest.raises(unbend.InvalidOption, match="go together"):
        unbend.Client(cert_file=party.cert)
    with pytest.raises(unbend.InvalidOption, match="one of them"):
        unbend.Client(tls=True, credentials=grpc.ssl_channel_credentials())
