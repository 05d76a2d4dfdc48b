"""Certificates of both transports, which may be exchanged while the service runs."""

from __future__ import annotations

import ssl
from pathlib import Path
from typing import Any

import grpc

from unbend_service.domain.errors import InvalidOption
from unbend_service.settings import Settings


class _Context(ssl.SSLContext):
    """Hands each new connection to the context of the day; an event loop keeps the one that it was given."""

    today: ssl.SSLContext

    def wrap_bio(self, *args: Any, **kwargs: Any) -> ssl.SSLObject:
        return self.today.wrap_bio(*args, **kwargs)

    def wrap_socket(self, *args: Any, **kwargs: Any) -> ssl.SSLSocket:
        return self.today.wrap_socket(*args, **kwargs)


class Certificates:
    """Certificate, key, and the authorities of clients, as the settings name them.

    What is exchanged holds for new connections; those that stand go on. Blocking.

    Raises:
        InvalidOption: a file is missing, broken, or the key is not that of the certificate.
    """

    def __init__(self, cert: Path, key: Path, client_ca: Path | None) -> None:
        self._paths = [("tls_cert", cert), ("tls_key", key)]
        if client_ca is not None:
            self._paths.append(("tls_client_ca", client_ca))
        self._cert, self._key, self._client_ca = cert, key, client_ca
        self._seen: list[tuple[int, ...]] = []
        self._http, self._ops = (_Context(ssl.PROTOCOL_TLS_SERVER) for _ in range(2))
        self._configuration: Any = None
        self._given: Any = None
        self.refresh()

    def http(self) -> ssl.SSLContext:
        """For HTTP: asks for a certificate of the client if there are authorities for it."""
        return self._http

    def ops(self) -> ssl.SSLContext:
        """For health and metrics: never asks for one, since probes have none."""
        return self._ops

    def grpc(self) -> grpc.ServerCredentials:
        """For gRPC, as :meth:`http`."""
        self._given = self._configuration
        credentials: grpc.ServerCredentials = grpc.dynamic_ssl_server_credentials(
            self._configuration, self._changed, require_client_authentication=self._client_ca is not None
        )
        return credentials

    def refresh(self) -> bool:
        """Reads the files again if one of them changed; returns whether one did.

        Raises:
            InvalidOption: what is there now cannot be used; what was there before stays. Raised once a change.
        """
        seen = [_identity(path) for _, path in self._paths]
        if seen == self._seen:
            return False
        self._seen = seen
        for setting, path in self._paths:
            _check_readable(setting, path)
        try:
            http, ops = self._context(self._client_ca), self._context(None)
            pair = self._key.read_bytes(), self._cert.read_bytes()
            authorities = self._client_ca.read_bytes() if self._client_ca is not None else None
        except (OSError, ssl.SSLError) as error:
            reason = error.strerror or getattr(error, "reason", "") or str(error)
            raise InvalidOption(
                f"The certificates cannot be used: {reason}.",
                allowed="a PEM chain, its PEM key without a password, PEM authorities",
                setting="tls_cert",
            ) from None
        self._http.today, self._ops.today = http, ops
        self._configuration = grpc.ssl_server_certificate_configuration([pair], authorities)
        return True

    def _context(self, client_ca: Path | None) -> ssl.SSLContext:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        context.load_cert_chain(self._cert, self._key, password="")  # of a locked key nobody could be asked
        if client_ca is not None:
            context.load_verify_locations(client_ca)
            context.verify_mode = ssl.CERT_REQUIRED
        return context

    def _changed(self) -> Any:
        """Called by gRPC for each connection; None: as before."""
        if self._given is self._configuration:
            return None
        self._given = self._configuration
        return self._given


def read_certificates(settings: Settings) -> Certificates | None:
    """Those that the settings name; None for plain text.

    Raises:
        InvalidOption: one of the settings lacks another, or the files cannot be used.
    """
    if settings.tls_cert is None and settings.tls_key is None and settings.tls_client_ca is None:
        return None
    if settings.tls_cert is None or settings.tls_key is None:
        missing = "tls_cert" if settings.tls_cert is None else "tls_key"
        raise InvalidOption("A certificate and its key go together.", allowed="both", setting=missing)
    return Certificates(settings.tls_cert, settings.tls_key, settings.tls_client_ca)


def _identity(path: Path) -> tuple[int, ...]:
    try:
        status = path.stat()
    except OSError:
        return (-1,)
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


def _check_readable(setting: str, path: Path) -> None:
    try:
        with path.open("rb"):
            pass
    except OSError as error:
        raise InvalidOption(f"{path} cannot be read: {error.strerror}.", setting=setting) from None
